"""A package of one's own with a task, an agent or a world model in it, ready to be changed: ``imagine-bench new``."""

from __future__ import annotations

import keyword
import re
import shlex
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

import jinja2

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.store.files import expanded, make_folder, write_bytes

KINDS = {"task": registry.TASK_GROUP, "agent": registry.AGENT_GROUP, "model": registry.WORLD_MODEL_GROUP}
_PYPROJECT = """[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "{name}"
version = "0.1"
dependencies = ["imagine-bench"]

[project.entry-points."{group}"]
{name} = "{name}:ENTRY"

[tool.setuptools]
package-dir = {{"" = "src"}}
py-modules = ["{name}"]

[tool.pytest.ini_options]
addopts = ["--imagine-bench-{kind}={name}"]
"""


def new_package(kind: str, name: str, out: Path) -> str:
    """Write ``out/<name>/``: ``pyproject.toml``, and ``src/<name>.py``, which passes the checks as it is.

    Returns the next steps, in words.

    Raises:
        UnknownNameError: Another kind than those of :data:`KINDS`.
        InvalidValueError: A name that no module can have, or that one has, or that is taken; a folder that exists.
    """
    group = KINDS[require_known("kind of package", kind, KINDS)]
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,60}", name) or keyword.iskeyword(name):
        raise InvalidValueError(f"{name!r} cannot be a module; give small letters, digits and _, such as my_{kind}.")
    taken = {
        **registry.TASKS, **registry.REGRESSIONS, **registry.AGENTS, **registry.PLAYERS, **registry.REGRESSORS,
        **registry.WORLD_MODELS,
    }  # fmt: skip
    if name in taken or registry.guest_with(group, name) is not None:
        raise InvalidValueError(f"{name!r} is a name of imagine_bench already; give another name.")
    folder = expanded(out) / name
    if folder.exists():
        raise InvalidValueError(f"{folder} exists; give another name or --out. Nothing was written.")
    if find_spec(name) is not None:
        raise InvalidValueError(f"{name!r} is a module that Python has already; give another name.")
    template = (resources.files("imagine_bench.tools") / "templates" / f"{kind}.py.j2").read_text()
    words = {"name": name, "camel": name.title().replace("_", ""), "title": name.replace("_", " ").capitalize()}
    code = jinja2.Environment(autoescape=False, keep_trailing_newline=True).from_string(template).render(**words)
    source = make_folder(folder / "src")  # beside pyproject.toml the folder would hide the module
    write_bytes(source / f"{name}.py", code.encode())
    write_bytes(folder / "pyproject.toml", _PYPROJECT.format(kind=kind, name=name, group=group).encode())
    typed = shlex.quote(str(folder))
    return f"Wrote {folder}.\nNext: pip install -e {typed} && imagine-bench check --{kind} {name} (or pytest {typed})"
