"""The agent ``factored_own``: ``factored``, which begins with nothing and learns to see while it acts.

``looks`` finds factors and values in its own frames, ``memory`` decides what is worth remembering of an episode,
``agent`` does both as frames come, ``picture`` shows people what it sees. Nothing here knows a task.
"""
