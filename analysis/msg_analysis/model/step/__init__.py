"""What one step of an experiment does: matrices, noise, loss on the air, phases of the agents' timers.

What belongs to one run is in ``model.run``. May import model.experiment and what is below it.
"""
