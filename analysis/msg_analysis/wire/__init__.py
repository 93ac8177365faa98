"""The network's messages as bytes, the topics, and why messages are refused.

Files of messages belong to ``bags``. May import model.
"""
