"""The contract that tasks, agents and world models keep, ours and those of any package.

``imagine-bench check --task X`` names the rules that hold; ``pytest --imagine-bench-task X`` checks it with a
package's tests.
"""
