"""The network's messages as bytes: CDR, the codec of states, and the description of the message types.

Files of messages belong to ``bags``. May import model.arithmetic.
"""
