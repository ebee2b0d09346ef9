"""The registry lines of the agents and of their world model; torch is not imported before one is made."""

from __future__ import annotations

from imagine_bench.registry import AgentEntry, WorldModelEntry

FACTORED = AgentEntry(
    make="imagine_bench_factored.learned:make",
    relative_cost=4.0,
    needs_encoder=False,
    settings="imagine_bench_factored.settings:LEARNED",
    description="Begins with nothing: from its own frames it learns discrete factors, which of them an action "
    "changes, and the rewards; it explores where it is uncertain and plans in its model.",
)
GIVEN = AgentEntry(
    make="imagine_bench_factored.agent:make",
    relative_cost=3.0,
    encoder_kind="codes",
    settings="imagine_bench_factored.settings:HYPERPARAMETERS",
    description="Like factored, but it is given an encoder of discrete factors and learns no perception; it can "
    "also show its imagination and query an oracle.",
)
STRUCTURED = WorldModelEntry(
    make="imagine_bench_factored.structured:make",
    title="structured",
    encoder_kind="codes",
    description="The model of the agent factored: tables over discrete factors, whose structure it learns.",
)
