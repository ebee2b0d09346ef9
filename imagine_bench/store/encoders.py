"""Which encoder artefact a bench uses: the task's own, bundled or trained once, a bundled one by name, or a file."""

from __future__ import annotations

import hashlib
import os
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, UnknownNameError
from imagine_bench.interfaces import TaskSpec, bundled_name
from imagine_bench.store.files import lock, make_folder, read_json, sha256

_TRAIN = "imagine_bench.agents.encoders.cli:retrain"
_SUFFIX = ".safetensors"


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
    frames = spec.render_macrostates(np.array(spec.rules.states[:8]), appearance, np.random.default_rng(0))
    looks = hashlib.sha256(f"{spec.preprocessing}/{spec.config_group}/".encode() + frames.tobytes()).hexdigest()[:12]
    return cache_folder() / "encoders" / looks / f"{bundled_name(spec.encoder, appearance, kind)}{_SUFFIX}"


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
    known = bundled()
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
        return known[given]
    path = Path(given).expanduser()
    if (os.sep in given or given.endswith(_SUFFIX)) and path.is_file():
        return path.resolve()
    raise UnknownNameError("encoder", given, known)


def own(spec: TaskSpec, appearance: str, kind: str) -> Path:
    """The task's own encoder of a kind; that of another package's task is trained once.

    Raises as :func:`resolve`, and BusyError: another process trains it.
    """
    if spec.id not in registry.TASKS and bundled_name(spec.encoder, appearance, kind) not in bundled():
        path = cached(spec, appearance, kind)
        make_folder(path.parent)
        with lock(path.parent / ".lock", f"The folder of encoders {path.parent}"):
            if not path.is_file():
                print(f"{spec.id} has no encoder for {kind} at {appearance}; one is trained into {path.parent}, once.")
                recipe = "codes" if kind == "codes" else "default"
                registry.load(_TRAIN)(spec, recipe=recipe, appearance=appearance, seed=0, out=path.parent)
        return path
    return resolve(spec, appearance, kind=kind)


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
