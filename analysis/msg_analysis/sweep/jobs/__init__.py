"""One point of a sweep as a job, what a worker does with it, and the pool of workers.

The sweep as a whole belongs to ``sweep``. May import inference, twin and what is below them.
"""
