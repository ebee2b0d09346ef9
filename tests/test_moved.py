"""Modules that moved are found by their old paths, with one warning; no module hides a name of the package."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import warnings

import pytest

import imagine_bench
from imagine_bench import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_gives_the_objects_of_the_new_one_and_warns_once(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} is now {MOVED[old]}; import it from there"):
        module = importlib.import_module(old)
    new = vars(importlib.import_module(MOVED[old]))
    public = [name for name in new if not name.startswith("__")]
    assert all(getattr(module, name) is new[name] for name in public)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert importlib.import_module(old) is module


def test_a_path_that_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"imagine_bench\.never_was"):
        importlib.import_module("imagine_bench.never_was")


def test_no_module_hides_the_function_bench() -> None:
    names = [module.name for module in pkgutil.iter_modules(imagine_bench.__path__)]
    assert "bench" not in names and not set(names) & {old.split(".")[1] for old in MOVED if old.count(".") == 1}
