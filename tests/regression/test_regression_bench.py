"""A regression bench through the same machinery as every other: run, resume, read, report, recording, wrong words."""

from __future__ import annotations

import csv
import io
import itertools
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench_regression import settings as regressor_settings
from imagine_bench_regression import toy_regression
from imagine_bench_regression.sections import change, choices, claim, figure_4_1, squared_error_terms, workspace
from recordings import contents

from imagine_bench.cli import exit_code as main
from imagine_bench.cli.observers import observers_of
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.protocols.data import Progress, RunSpec
from imagine_bench.regression.runner import PairResult, RegressionResult, RegressionRun, run
from imagine_bench.report.page import number, write_page
from imagine_bench.report.regression import report_page
from imagine_bench.running.bench import plan
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import SeedTree

SURE = 4.5
"""Standard errors beyond which chance is no explanation."""
_TINY = (("components", 3), ("epochs", 4), ("hidden", [16, 16]), ("members", 2), ("weight_samples", 5))
VARIANTS = ("base", "low_data", "high_noise")


def tiny(task: str, agent: str = "mc_dropout", **changes: Any) -> RunSpec:
    values = {"networks": 2, "test_points": 30, "overrides": _overrides(agent), "agents": (agent,), **changes}
    protocol, encoders = plan(task, "smoke", **values)
    assert encoders == {}
    return RunSpec(protocol=protocol, agent=agent, seed=0, observers=observers_of(protocol))


def _overrides(agent: str) -> tuple[tuple[str, Any], ...]:
    return tuple(pair for pair in _TINY if agent == "ensemble" or pair[0] != "members")


LEARNED = (("components", 3), ("epochs", 20), ("hidden", [16, 16]), ("learning_rate", 0.01), ("weight_samples", 5))
TOY = tiny("toy_regression", variants=VARIANTS, overrides=LEARNED)


def silent(_: Progress) -> None:
    pass


def result_of(spec: RunSpec, found: RegressionRun, folder: Path) -> RegressionResult:
    return RegressionResult(protocol=spec.protocol, runs=(found,), environment={}, folder=folder, wall_s=1.0)


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> RegressionRun:
    return run(TOY, tmp_path_factory.mktemp("toy"), silent)


def test_a_run_measures_every_network_of_every_variant(toy: RegressionRun) -> None:
    assert [(row["variant"], row["network"]) for row in toy.rows] == [
        (variant, index) for variant in VARIANTS for index in (0, 1)
    ]
    for row in toy.rows:
        assert all(np.isfinite(float(v)) for k, v in row.items() if k != "variant" and not k.startswith("auroc"))
        assert 0 <= float(row["coverage_0.8"]) <= 1
    assert toy.recording is not None
    for variant in VARIANTS:
        found = toy.evaluations[variant]
        data = toy_regression.training(variant, SeedTree(0).child("network", 0).child("data").generator())
        np.testing.assert_array_equal(found["training_x"], data.inputs[:, 0])
        assert found["epistemic"].shape == (2, 1000)
        assert (found["epistemic"] > 0).all()
        assert (found["stationarity"] <= np.log(5) + 1e-9).all()
    with pytest.raises(ArtefactError, match="is of a regression task, in which no agent acts"):
        load_trained(toy.folder)


@pytest.mark.parametrize("agent", ("ensemble", "mc_dropout"))
def test_interrupted_and_resumed_is_uninterrupted(agent: str, tmp_path: Path) -> None:
    variants = ("low_data", "base", "high_noise")  # an order that no sorting gives
    spec = tiny("toy_regression", agent, variants=variants, test_points=5, networks=1, recorded=False)
    told_whole: list[Progress] = []
    whole = run(spec, tmp_path / "whole", told_whole.append)
    arrays = tmp_path / "parts" / "evaluation.npz"
    for after in (2, 7, 7):  # in the first variant, the second and the third
        told = itertools.count()
        earlier = arrays.read_bytes() if arrays.exists() else b""

        def observe(_: Progress, told: Iterator[int] = told, after: int = after) -> None:
            if next(told) == after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run(spec, tmp_path / "parts", observe)
    arrays.write_bytes(earlier)  # a kill between the second variant's rows and its arrays leaves these
    told_after: list[Progress] = []
    parts = run(spec, tmp_path / "parts", told_after.append)
    assert 0 < told_whole[0].done < told_after[0].done, "it must have gone on, not begun anew"
    timeless = [[{k: v for k, v in row.items() if not k.endswith("cpu_s")} for row in r.rows] for r in (whole, parts)]
    assert str(timeless[0]) == str(timeless[1]), "in which a NaN equals itself"
    assert list(parts.evaluations) == list(whole.evaluations) == list(variants)
    assert arrays.read_bytes() == (whole.folder / "evaluation.npz").read_bytes()
    told_after.clear()
    assert str(run(spec, whole.folder, told_after.append).rows) == str(whole.rows)
    assert told_after == [], "a finished run is only read"


def test_one_regressor_with_two_settings_in_one_bench(tmp_path: Path) -> None:
    agents = ("mc_dropout:epochs=6", "mc_dropout")
    spec = tiny("toy_regression", agents=agents, networks=8, variants=("base",), test_points=2, recorded=False)
    begun_s = time.process_time()
    runs = [run(replace(spec, agent=agent), tmp_path / agent[-1], silent) for agent in agents]
    assert [each.settings["epochs"] for each in runs] == [6, 4]
    shares = [float(row[name]) for each in runs for row in each.rows for name in ("train_cpu_s", "measure_cpu_s")]
    assert sum(shares) < time.process_time() - begun_s, "networks that train together share the time"


def test_networks_err_by_the_sum_of_the_causes(toy: RegressionRun, tmp_path: Path) -> None:
    """Of any network, however bad: the measured error is the sum of the terms of equation 4.8, but for sampling."""
    result = result_of(TOY, toy, tmp_path)
    rows = csv.DictReader(io.StringIO(report_page(result).files["decomposition.csv"]))
    for pair in result.pairs.values():
        x = pair.first["x"]
        for words, here in (("data", abs(x) <= 30), ("region", abs(x) <= 10), ("beyond", x > 30)):
            parts = {name: each[:, here] for name, each in squared_error_terms(pair).items()}
            means = {name: number(each.mean()) for name, each in parts.items()}
            left = parts.pop("measured") - sum(parts.values())
            written = f"{number(left.mean())} ± {number(1.96 * left.std() / left.size**0.5)}"
            assert next(rows) == {"": f"{pair.label}: {words}", **means, "measured − sum": written}
        terms = squared_error_terms(pair)
        rest = terms.pop("measured") - sum(terms.values())
        error = rest.std() / np.sqrt(rest.size)
        assert abs(rest.mean()) < SURE * error
        for name in ("true modal", "spread"):
            assert (rest + terms[name]).mean() > SURE * error, f"{name} could be left out"


def test_figure_4_1_draws_standard_deviations(toy: RegressionRun) -> None:
    found = toy.evaluations["base"]
    for axes, kind in zip(figure_4_1({"base": found}).axes[1:], ("epistemic", "modal", "aleatoric"), strict=True):
        true, estimated = (np.square(line.get_ydata()) for line in axes.get_lines())
        np.testing.assert_allclose(true, np.atleast_2d(found[f"true_{kind}"])[0])
        np.testing.assert_allclose(estimated, found[kind][0])


def test_a_page_shows_every_table_and_figure(toy: RegressionRun, tmp_path: Path) -> None:
    report = report_page(result_of(TOY, toy, tmp_path))
    assert all(re.search(r"\], asked [≥≤>] \d; \d of 2 networks hold\.$", answer) for answer in report.answers)
    page = write_page(tmp_path, report)
    names = {path.stem for path in page.parent.glob("*.png")} | {path.stem for path in page.parent.glob("*.csv")}
    assert names == {"figure_4_1_mc_dropout", "results", "claims", "decomposition", "calibration"}
    claims = (page.parent / "claims.csv").read_text().splitlines()
    assert claims[0] == "network,claim,measured,asked,networks that hold"
    assert len(claims) == 1 + 7
    assert ">nan" not in page.read_text()


def robot() -> RegressionRun:
    """A run of two networks that chose four times among three places."""
    rng = np.random.default_rng(0)
    points = np.stack(np.meshgrid(*[np.linspace(-1.1, 1.1, 9)] * 2), axis=-1).reshape(-1, 2)
    arrays = {"babbling": points[points[:, 0] > 0.3], "map/points": points, "map/outside_m": np.hypot(*points.T) > 0.9}
    arrays |= {f"map/{name}": rng.random((2, 81, 3)) for name in SCORES[:3]}
    arrays |= {f"map/{name}": rng.random((2, 81)) for name in ("error", "stationarity")}
    for part in ("decision", "disc"):
        arrays[f"{part}/error"] = np.tile([0.1, 0.2, 0.6], (2, 4, 1))
        for name in SCORES:
            place = {"aleatoric": 1, "nll": 1, "modal": 2}.get(name, 0)
            arrays[f"{part}/{name}"] = np.tile(np.roll([0, 1, 2], place), (2, 4, 1))
    names = [
        "coverage_0.5",
        "coverage_0.8",
        "coverage_0.95",
        "log_score",
        "wrong",
        *(f"auroc_{name}" for name in SCORES),
    ]
    rows = [{"variant": "1000", "network": index, **dict.fromkeys(names, 0.5)} for index in (0, 1)]
    return RegressionRun(agent="mc_dropout", seed=0, rows=rows, evaluations={"1000": arrays}, folder=Path())


def test_table_4_1_sums_the_errors_of_the_places_of_least_uncertainty(tmp_path: Path) -> None:
    result = result_of(tiny("robot_ik", variants=("1000",)), robot(), tmp_path)
    (pair,) = result.pairs.values()
    sums, ratios = choices(pair, "decision")
    by_hand = {"epistemic": 0.4, "aleatoric": 0.8, "modal": 2.4, "min": 0.4, "max": 2.4, "random": 1.2}
    assert {name: sums[name] for name in by_hand} == {name: f"{total:.2f} (0.00)" for name, total in by_hand.items()}
    assert [ratios[name].split()[0] for name in ("epistemic", "aleatoric", "modal")] == ["0.33", "0.67", "2.00"]
    maps = pair.first
    drawn = [np.ravel(axes.collections[0].get_array()) for axes in workspace(maps).axes if axes.collections]
    assert (drawn[0] > 0).tolist() == (maps["map/points"][:, 0] > 0.3).tolist(), "where it babbled"
    stds = [np.sqrt(maps[f"map/{kind}"][0].T) for kind in ("epistemic", "modal", "aleatoric")]
    np.testing.assert_allclose(drawn[1:12], [maps["map/error"][0], maps["map/stationarity"][0], *np.concatenate(stds)])
    page = report_page(result)
    for said, where in zip(page.answers, ("within reach", "anywhere on the disc"), strict=True):
        assert re.search(rf"1000 samples, .* places {where}: .* 0\.33 .*by epistemic .* 0\.67 .*by negative log", said)
    (image,) = [image for section in page.sections for image in section.images]
    assert image.name == "figures_4_2_4_3_mc_dropout_1000" and len(image.png) > 10_000
    assert "thesis,1000,3.89 (0.67)" in page.files["choices.csv"], "the thesis' own is below"


def test_a_claim_compares_the_region_and_follows_the_distance() -> None:
    x = [-20.0, -10.0, 10.0, 29.0, 31.0, 35.0, 40.0]
    base = [[9.0, 1.0, 3.0, 9.0, 1.0, 2.0, 3.0], [9.0, 2.0, 2.0, 9.0, 3.0, 2.0, 1.0]]
    few = [[0.0, 4.0, 8.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]]
    measured = {name: {"x": np.array(x), "modal": np.array(each)} for name, each in (("base", base), ("few", few))}
    learned = RegressionRun(agent="mc_dropout", seed=0, rows=(), evaluations=measured, folder=Path())
    of_base, of_few = (PairResult("mc_dropout", variant, (learned,)) for variant in measured)
    assert change(of_few, of_base, "modal").tolist() == [3.0, 0.5]
    assert change(of_base, of_base, "modal").tolist() == pytest.approx([1.0, -1.0])


def test_claims_by_hand() -> None:
    values = np.array([2.0, 3.0, 4.0])
    assert [claim("", "", values, asked)["networks that hold"] for asked in ("≥ 3", "≤ 3", "> 3", "")] == [
        "2 of 3", "2 of 3", "1 of 3", "",
    ]  # fmt: skip
    assert claim("", "", values)["measured"] == "3.00 [2.00, 4.00]"


@pytest.mark.slow
def test_the_command_ends_in_a_table_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [f"{name}={value}".replace(" ", "") for name, value in _overrides("mc_dropout")]
    words = [
        "bench", "--task", "robot_ik", "--preset", "smoke", "--agents", "mc_dropout", "--variants", "1000",
        "--networks", "1", "--workers", "1", "--out", str(tmp_path), "--set", *settings,
    ]  # fmt: skip
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "MC dropout, 1000" in said and "3.89 (0.67)" in said
    (folder,) = (tmp_path / "robot_ik").iterdir()
    assert "Table 4.1" in (folder / "report" / "index.html").read_text()
    named = contents(folder / "mc_dropout" / "seed_0" / "recording.rrd")
    assert any(path.startswith("/scene") for path in named) and named["/choice/candidates"] >= {"sim_time", "choice"}


@pytest.mark.parametrize("name", ["minimal", "fast", "published"])
def test_an_ensemble_is_compared_fairly_with_one_network(name: str) -> None:
    """It never costs more; dropout is of the one, members of the other; published, both sample as many values."""
    resolve = regressor_settings.HYPERPARAMETERS.resolve
    one, ensemble = (resolve(name, {"dropout": 0.1}, group) for group in ("mc_dropout", "ensemble"))
    assert ensemble.epochs * ensemble.members <= one.epochs
    assert (one.dropout, one.members, ensemble.dropout) == (0.1, 1, 0.0)
    if name == "published":
        assert ensemble.members * ensemble.divergence_draws == one.weight_samples * one.divergence_draws
