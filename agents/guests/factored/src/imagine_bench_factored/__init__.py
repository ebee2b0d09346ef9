"""The agents ``factored`` and ``factored:given``: a structured world model over codes of factors, and planning in it.

Read in this order: ``perception`` (frames to codes and back), ``factors`` (codes, transitions, replay), ``dynamics``
(the effect of an action on each factor), ``outcomes`` (rewards and ends), ``model`` (both together), ``planner``
(values, novelty and next codes), ``agent``. Nothing here knows a task: no macrostate, no rule, no reward, no number of
objects.
"""
