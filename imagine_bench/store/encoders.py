"""Which encoder artefact a bench uses: the task's own, bundled or trained once, a bundled one by name, or a file."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError
from imagine_bench.interfaces import APPEARANCES, TaskSpec, bundled_name
from imagine_bench.registry.entries import file_name
from imagine_bench.rules import states_of
from imagine_bench.store.files import lock, make_folder, read_json, sha256

_TRAIN = "imagine_bench.agents.encoders.cli:retrain"
_FIT = "imagine_bench.agents.encoders.offered:fit_offered"
_SUFFIX = ".safetensors"
_PATIENCE_S = 3600.0


def bundled() -> dict[str, Path]:
    """The encoders that come with the package, by name."""
    folder = Path(str(resources.files("imagine_bench.assets") / "encoders"))
    return {path.stem: path for path in sorted(folder.glob(f"*{_SUFFIX}"))}


def cache_folder() -> Path:
    """Where encoders of tasks that none is bundled for are kept: ``$IMAGINE_BENCH_CACHE``, or the user's cache."""
    given = os.environ.get("IMAGINE_BENCH_CACHE")
    return Path(given).expanduser() if given else Path(platformdirs.user_cache_dir("imagine_bench"))


def cached(spec: TaskSpec, appearance: str, kind: str) -> Path:
    """Where the trained encoder of a task's looks belongs, be it there or not; other looks are another folder."""
    frames = spec.render_macrostates(np.array(states_of(spec.rules)[:8]), appearance, np.random.default_rng(0))
    looks = hashlib.sha256(f"{spec.preprocessing}/{spec.config_group}/".encode() + frames.tobytes()).hexdigest()[:12]
    return cache_folder() / "encoders" / looks / f"{bundled_name(spec.encoder, appearance, kind)}{_SUFFIX}"


def offered(spec: TaskSpec, appearance: str, name: str) -> Path:
    """The artefact of an encoder that an installed package offers, made once for the looks of a task.

    Raises:
        InvalidValueError: What is offered gives no latents for frames.
        SetupError: As :func:`.registry.task_entry`.
        BusyError: Another process makes it, for longer than an hour.
    """
    entry = registry.offered(name, {}, registry.ENCODER_GROUP)
    frames = spec.render_macrostates(np.array(states_of(spec.rules)[:8]), appearance, np.random.default_rng(0))
    try:
        features = np.asarray(registry.load(entry.make)().encode(frames), dtype=np.float64)
        shape_is_right = features.ndim == 2 and len(features) == len(frames) and np.isfinite(features).all()
    except Exception as error:  # whatever a package does wrong is one sentence
        raise InvalidValueError(
            f"The encoder {name} ({entry.make}) failed: {type(error).__name__}: {error}."
        ) from error
    if not shape_is_right:
        raise InvalidValueError(
            f"Encoder {name} ({entry.make}) gave latents of shape {features.shape} for {len(frames)} frames; it must "
            f"give finite numbers of shape ({len(frames)}, Z)."
        )
    known = hashlib.sha256(f"{entry.make}/{spec.preprocessing}/".encode() + np.round(features, 3).tobytes()).hexdigest()
    path = cache_folder() / "encoders" / known[:12] / f"{name}-{file_name(spec.id)}-{appearance}{_SUFFIX}"
    what = f"The scale and the probe of {name} for {spec.id} at {appearance} are made"
    _once(path, what, lambda: registry.load(_FIT)(spec, name=name, offer=entry.make, appearance=appearance, path=path))
    return path


def find(used: str) -> Path | None:
    """The bundled or trained encoder of an identity; None where there is none."""
    name = used.partition("@")[0]
    there = [bundled()[name]] if name in bundled() else []
    there += sorted((cache_folder() / "encoders").glob(f"*/{name}{_SUFFIX}"))
    return next((path for path in there if identity(path) == used), None)


def resolve(spec: TaskSpec, appearance: str, given: str | None = None, kind: str = "latents") -> Path:
    """The encoder file to use: ``given``, a bundled name or a path, or the task's own of a kind (latents or codes).

    Raises:
        UnknownNameError: ``given`` is neither.
        ArtefactError: The task has no bundled encoder at this appearance level.
    """
    known = {**bundled(), **registry.offers(registry.ENCODER_GROUP)}
    if given is None:
        name = bundled_name(spec.encoder, appearance, kind)
        if name not in known:
            raise ArtefactError(
                f"No encoder {name!r} is bundled; train one with "
                f"'imagine-bench encoder --task {spec.id} --appearance {appearance}"
                f"{' --recipe codes' if kind == 'codes' else ''}' and give it with --encoder."
            )
        return known[name]
    if given in known:
        return bundled()[given] if given in bundled() else offered(spec, appearance, given)
    path = Path(given).expanduser()
    if (os.sep in given or given.endswith(_SUFFIX)) and path.is_file():
        return path.resolve()
    raise UnknownNameError("encoder", given, known)


def own(spec: TaskSpec, appearance: str, kind: str) -> Path:
    """The task's own encoder of a kind; one of looks that none is bundled for is trained once.

    Raises as :func:`resolve`, and BusyError: another process trains it, for longer than an hour.
    """
    named = registry.is_own(spec.id) and appearance in APPEARANCES
    looks_bundled = named and any(name.startswith(f"{spec.encoder}-") for name in bundled())
    if not looks_bundled and bundled_name(spec.encoder, appearance, kind) not in bundled():
        path = cached(spec, appearance, kind)
        recipe = "codes" if kind == "codes" else "default"
        settings = {"recipe": recipe, "appearance": appearance, "seed": 0, "out": path.parent}
        what = f"{spec.id} has no encoder for {kind} at {appearance}; one is trained"
        _once(path, what, lambda: registry.load(_TRAIN)(spec, **settings))
        return path
    return resolve(spec, appearance, kind=kind)


def _once(path: Path, what: str, make: Callable[[], object]) -> None:
    """Make an artefact unless it is there; a process waits while another makes it."""
    make_folder(path.parent)
    with lock(path.parent / ".lock", f"The folder of encoders {path.parent}", patience_s=_PATIENCE_S):
        if not path.is_file():
            print(f"{what} into {path.parent}, once.")
            make()


def kind(path: Path) -> str:
    """Whether an encoder gives ``"latents"`` or ``"codes"``, by its card. Raises ArtefactError: the card is damaged."""
    card = path.with_suffix(".json")
    return "codes" if card.is_file() and read_json(card, "an encoder's card").get("code_sizes") else "latents"


def identity(path: Path) -> str:
    """What stands for an encoder in a protocol: its name and 12 digits of its digest, or ArtefactError."""
    return f"{path.stem}@{sha256(path)[:12]}"


def card(used: str | None) -> dict[str, Any] | None:
    """The card of an encoder that :func:`find` finds; None where it finds none. Raises ArtefactError: damaged."""
    path = None if used is None else find(used)
    if path is None or not path.with_suffix(".json").is_file():
        return None
    return read_json(path.with_suffix(".json"), "an encoder's card")
