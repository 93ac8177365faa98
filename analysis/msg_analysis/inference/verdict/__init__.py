"""The verdict on one run or several: evidence, comparison, family of tests.

How it is printed belongs to ``report``. May import all other folders of inference except online.
"""
