"""What imagine_bench finds by the entry points."""

from __future__ import annotations

from imagine_bench.registry import AgentEntry, WorldModelEntry

AGENT = AgentEntry(
    make="recaller.agent:Recaller",
    encoder_kind="codes",
    settings="recaller.settings",
    title="recaller",
    description="Q-learning in a table that also learns from rollouts recalled at random.",
)
MODEL = WorldModelEntry(
    make="recaller.model:make", title="recall", description="Draws from what followed the same frame before."
)
