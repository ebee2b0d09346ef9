"""The suite's own agent: a structured world model over discrete codes, doubt about it, and planning in imagination.

Read in this order: ``dynamics`` (what an action does to each part), ``outcomes`` (what is rewarded, what ends),
``model`` (both, with their doubt), ``planner`` (imagining every future), ``questions`` (what to ask a
teacher), ``agent`` (what it does with them).
Nothing here knows a task: no macrostate, no rule, no reward, no number of objects.
"""
