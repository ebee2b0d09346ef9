"""Which encoder artefact a bench uses: the task's own, bundled or trained once, a bundled one by name, or a file."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from safetensors import safe_open

from imagine_bench import registry
from imagine_bench.appearance import appearance_typed
from imagine_bench.errors import ArtefactError, InvalidValueError, SetupError, UnknownNameError
from imagine_bench.interfaces import APPEARANCES, Frame, TaskSpec, bundled_name
from imagine_bench.registry.entries import file_name
from imagine_bench.rules import states_of
from imagine_bench.store.files import expanded, lock, make_folder, reading, sha256
from imagine_bench.values import Json

TRAIN = "imagine_bench.agents.encoders.cli:retrain"
_FIT = "imagine_bench.agents.encoders.training:fit_offered"
_BUNDLED_AT = [name for name in APPEARANCES if name != "harsh"]
"""Named appearances for which encoders are made beforehand; for all others they are trained on first use."""
_SUFFIX = ".safetensors"
_PATIENCE_S = 3600.0
READS_AT_LEAST = 0.9
"""Share of held-out frames whose macrostate is read right; reports and commands name an encoder that is below it."""


def bundled() -> dict[str, Path]:
    """The encoders that come with the package, by name."""
    folder = Path(str(resources.files("imagine_bench.assets") / "encoders"))
    return {path.stem: path for path in sorted(folder.glob(f"*{_SUFFIX}"))}


def cache_folder() -> Path:
    """Where encoders of tasks that none is bundled for are kept: ``$IMAGINE_BENCH_CACHE``, or the user's cache.

    Raises:
        InvalidValueError: The variable begins with a home folder that the system does not know.
        SetupError: It is not set, and the system knows no home folder of this user.
    """
    given = os.environ.get("IMAGINE_BENCH_CACHE")
    if given:
        return expanded(Path(given))
    try:
        return Path(platformdirs.user_cache_dir("imagine_bench"))
    except RuntimeError as error:
        raise SetupError("This user has no home folder; name one for encoders in IMAGINE_BENCH_CACHE.") from error


def _frames(spec: TaskSpec, appearance: str) -> Frame:
    """Some frames of a task."""
    return spec.render_macrostates(np.array(states_of(spec.rules)[:8]), appearance, np.random.default_rng(0))


def _place(made_for: bytes, name: str) -> Path:
    """Where an encoder that is made for ``made_for`` belongs, be it there or not."""
    return cache_folder() / "encoders" / hashlib.sha256(made_for).hexdigest()[:12] / f"{name}{_SUFFIX}"


def cached(spec: TaskSpec, appearance: str, kind: str) -> Path:
    """Where the trained encoder of a task's looks belongs, be it there or not; other looks are another folder."""
    made_for = f"{spec.preprocessing}/{spec.config_group}/".encode() + _frames(spec, appearance).tobytes()
    return _place(made_for, bundled_name(spec.encoder, appearance, kind))


def offered(spec: TaskSpec, appearance: str, name: str) -> Path:
    """The artefact of an encoder that an installed package offers, made once for the looks of a task.

    Raises:
        InvalidValueError: The offered object gives no latents for frames.
        SetupError: As :func:`.registry.task_entry`.
        BusyError: Another process makes it, for longer than an hour.
    """
    entry = registry.offered(name, {}, registry.ENCODER_GROUP)
    frames = _frames(spec, appearance)
    try:
        features = np.asarray(registry.load(entry.make)().encode(frames), dtype=np.float64)
        if features.ndim != 2 or len(features) != len(frames) or not np.isfinite(features).all():
            wanted = f"it must give finite numbers of shape ({len(frames)}, Z)"
            raise ValueError(f"{len(frames)} frames have latents of shape {features.shape}; {wanted}")
    except (Exception, SystemExit) as error:  # whatever a package does wrong is one sentence
        raise InvalidValueError(
            f"The encoder {name} ({entry.make}) failed: {type(error).__name__}: {error}."
        ) from error
    known = f"{entry.make}/{spec.preprocessing}/".encode() + np.round(features, 3).tobytes()
    path = _place(known, f"{name}-{file_name(spec.id)}-{appearance}")
    what = f"The scale and the probe of {name} for {spec.id} at {appearance_typed(appearance)} are made"
    _once(path, what, lambda: registry.load(_FIT)(spec, name=name, offer=entry.make, appearance=appearance, path=path))
    return path


def find(used: str) -> Path | None:
    """The bundled or trained encoder of an identity; None where there is none."""
    return next((path for path in of_name(used) if identity(path) == used), None)


def of_name(used: str) -> list[Path]:
    """The bundled and trained encoders of the name in an identity, whatever their content is."""
    name = used.partition("@")[0]
    trained = sorted((cache_folder() / "encoders").glob(f"*/{name}{_SUFFIX}"))
    return [bundled()[name], *trained] if name in bundled() else trained


def resolve(spec: TaskSpec, appearance: str, given: str) -> Path:
    """The encoder file that is meant by ``given``: a bundled name, one that a package offers, or a path.

    Raises:
        UnknownNameError: It is none of them.
        InvalidValueError: The path begins with a home folder that the system does not know.
    """
    if given in bundled():
        return bundled()[given]
    offers = registry.offers(registry.ENCODER_GROUP)
    if given in offers:
        return offered(spec, appearance, given)
    path = expanded(Path(given))
    if (os.sep in given or given.endswith(_SUFFIX)) and path.is_file():
        return path.resolve()
    raise UnknownNameError("encoder", given, [*bundled(), *offers])


def own(spec: TaskSpec, appearance: str, kind: str = "latents") -> Path:
    """The task's own encoder of a kind, latents or codes: the bundled one, else one that is trained once for its looks.

    Raises:
        ArtefactError: One of these looks is bundled, but not at this named appearance.
        BusyError: Another process trains it, for longer than an hour.
    """
    name = bundled_name(spec.encoder, appearance, kind)
    if name in bundled():
        return bundled()[name]
    has_others = any(other.startswith(f"{spec.encoder}-") for other in bundled())
    if has_others and registry.is_own(spec.id) and appearance_typed(appearance) in _BUNDLED_AT:
        raise ArtefactError(
            f"No encoder {name!r} is bundled; train one with 'imagine-bench encoder --task {spec.id} --appearance "
            f"{appearance_typed(appearance)}' (for codes with --recipe codes) and give it with --encoder."
        )
    path = cached(spec, appearance, kind)
    recipe = "codes" if kind == "codes" else "default"
    what = f"{spec.id} has no encoder for {kind} at {appearance_typed(appearance)}; one is trained"
    settings = {"recipe": recipe, "appearance": appearance, "seed": 0, "out": path.parent}
    _once(path, what, lambda: registry.load(TRAIN)(spec, **settings))
    return path


def _once(path: Path, what: str, make: Callable[[], object]) -> None:
    """Make an artefact unless it is there; a process waits while another makes it."""
    try:
        make_folder(path.parent)
    except SetupError as error:
        raise SetupError(f"{error} A folder of encoders may be named in IMAGINE_BENCH_CACHE.") from error
    with lock(path.parent / ".lock", f"The folder of encoders {path.parent}", patience_s=_PATIENCE_S):
        if not path.is_file():
            print(f"{what} into {path.parent}, once: up to two minutes on one core.", flush=True)
            make()


def kind(path: Path) -> str:
    """Whether an encoder gives ``"latents"`` or ``"codes"``, by its card. Raises ArtefactError: the file is damaged."""
    return "codes" if card_of(path).get("code_sizes") else "latents"


def identity(path: Path) -> str:
    """The identity of an encoder in a protocol: its name and 12 digits of its digest, or ArtefactError."""
    return f"{path.stem}@{sha256(path)[:12]}"


def card(used: str | None) -> dict[str, Any] | None:
    """The card of an encoder that :func:`find` finds; None where it finds none. Raises ArtefactError: damaged."""
    path = None if used is None else find(used)
    return None if path is None else card_of(path)


def low_share(known: Mapping[str, Any] | None) -> float | None:
    """Share of new frames whose whole macrostate a probe reads right from an encoder of this card, where it is low.

    None where at least READS_AT_LEAST are read right, where the card does not say it, and without one.
    """
    share: float = 1.0 if known is None else known.get("probe", {}).get("mlp", 1.0)
    return share if share < READS_AT_LEAST else None


def mark(share: float | None) -> str:
    """The words behind the name of an agent or model in tables, by its encoder's :func:`low_share`."""
    return "" if share is None else f" (encoder reads {share:.1%})"


def reading_warning(name: str, known: Mapping[str, Any] | None) -> str:
    """A warning about an encoder from which few frames are read right; empty where its card does not say so."""
    share = low_share(known)
    if share is None:
        return ""
    return (
        f"the encoder {name}, from which a probe reads only {share:.1%} of new frames right (less than "
        f"{READS_AT_LEAST:.0%}); scores say little of an agent that sees through it"
    )


def short_card(path: Path) -> dict[str, Json]:
    """The part of a card that reports read, which a bench keeps: the encoder may be elsewhere then."""
    whole = card_of(path)
    frames = whole.get("recipe", {}).get("frames", 0)
    return {"recipe": {"frames": frames}, "probe": whole.get("probe", {}), "offer": whole.get("offer", "")}


def card_of(path: Path) -> dict[str, Any]:
    """The card that an artefact holds; the ``.json`` beside it is for people and may be gone."""
    with reading(path, "an encoder with a card"), safe_open(path, framework="numpy") as file:
        return dict(json.loads(file.metadata()["card"]))
