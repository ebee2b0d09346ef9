"""The agent ``factored``: a structured world model over discrete codes of a scene's factors, and planning in it.

Read in this order: ``perception`` (frames to codes and back), ``factors`` (codes, transitions, replay), ``dynamics``
(the effect of an action on each factor), ``outcomes`` (rewards and ends), ``model`` (both together),
``exploration`` (which query to ask an oracle), ``planner`` (values, novelty and next codes), ``agent``.
Nothing here knows a task: no macrostate, no rule, no reward, no number of objects.
"""
