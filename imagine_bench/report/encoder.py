"""The cards of the encoders that a bench used, as the report shows them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.store import encoders
from imagine_bench.store.files import read_json
from imagine_bench.store.results import BenchResult


@dataclass(frozen=True, kw_only=True)
class EncoderView:
    """What the report knows of an encoder.

    Attributes:
        agents: Those that see through it.
        identity: As in the protocol: name and beginning of the digest.
        card: The card's contents; empty where the file is not among the bundled ones.
        picture: Real and reconstructed frames, a PNG file, or None.
    """

    agents: tuple[str, ...]
    identity: str
    card: dict[str, Any]
    picture: Path | None

    @property
    def file(self) -> str:
        """What the picture's copy is called beside the report."""
        return f"encoder-{self.identity.partition('@')[0]}.png"

    @property
    def rows(self) -> list[tuple[str, str]]:
        """The card in words: name and value."""
        return [row for key, value in self.card.items() for row in _rows(_NAMES.get(key, key), key, value)]


_NAMES = {
    "code_sizes": "values of each part",
    "cpu_s": "CPU seconds",
    "kl_nats": "KL from the prior (nats a frame)",
    "reconstruction": "reconstruction error",
    "latent_size": "latent size",
    "macrostate_names": "macrostate",
    "probe": "probe accuracy",
}
_HIDDEN = {"format", "cardinalities"}


def encoder_views(result: BenchResult) -> list[EncoderView]:
    """Card and picture of every encoder used, found beside the bundled artefact of the same content.

    Raises:
        ArtefactError: A bundled card is damaged.
    """
    readers: dict[str, list[str]] = {}
    for agent in result.protocol.agents:
        entry = registry.agent_entry(agent)
        identity = result.protocol.encoder_of(entry.encoder_kind)
        if entry.needs_encoder and identity is not None:
            readers.setdefault(identity, []).append(agent)
    return [_view(identity, tuple(agents)) for identity, agents in readers.items()]


def _view(identity: str, agents: tuple[str, ...]) -> EncoderView:
    for path in encoders.bundled().values():
        if encoders.identity(path) == identity:
            card = path.with_suffix(".json")
            picture = path.with_suffix(".png")
            return EncoderView(
                agents=agents,
                identity=identity,
                card=read_json(card, "an encoder's card") if card.is_file() else {},
                picture=picture if picture.is_file() else None,
            )
    return EncoderView(agents=agents, identity=identity, card={}, picture=None)


def _rows(name: str, key: str, value: Any) -> list[tuple[str, str]]:
    if key in _HIDDEN:
        return []
    if isinstance(value, dict):
        return [(name, ", ".join(f"{inner} {_text(key, number)}" for inner, number in value.items()))]
    return [(name, _text(key, value))]


def _text(key: str, value: Any) -> str:
    if key == "probe" and isinstance(value, float):
        return f"{100.0 * value:.2f} %"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(str(item) for item in value)
    return str(value)
