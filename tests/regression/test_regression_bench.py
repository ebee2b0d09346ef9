"""A regression bench through the same machinery as every other: run, resume, read, report, recording, wrong words."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench.agents.regressors import settings as regressor_settings
from recordings import contents, times

from imagine_bench import registry
from imagine_bench.cli import main
from imagine_bench.cli.observers import observers_of
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentState
from imagine_bench.interfaces.regression import SCORES, Mixtures, Prediction, RegressionData, RegressorContext
from imagine_bench.protocols.runs import Progress, RunSpec
from imagine_bench.regression.calibration import calibrate
from imagine_bench.regression.results import PairResult, RegressionResult, RegressionRun
from imagine_bench.regression.runner import run
from imagine_bench.regression.scores import log_score
from imagine_bench.report.audits import why_report
from imagine_bench.report.page import flat
from imagine_bench.report.regression import robot_ik, toy_regression, write_report
from imagine_bench.report.tables import number
from imagine_bench.running.bench import plan
from imagine_bench.running.task_types import task_types
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import SeedTree

_TINY = (("components", 3), ("epochs", 4), ("hidden", [16, 16]), ("members", 2), ("weight_samples", 5))


def tiny(task: str, agent: str = "mc_dropout", **changes: Any) -> RunSpec:
    values = {"networks": 2, "test_points": 30, "overrides": _overrides(agent), "agents": (agent,), **changes}
    protocol, encoders = plan(task, "smoke", **values)
    assert encoders == {}
    observers = observers_of(protocol)
    return RunSpec(protocol=protocol, agent=agent, seed=0, checkpoint_every_s=0.0, observers=observers)


VARIANTS = ("base", "low_data", "high_noise")


def _overrides(agent: str) -> tuple[tuple[str, Any], ...]:
    return tuple(pair for pair in _TINY if agent == "ensemble" or pair[0] != "members")


TOY = tiny("toy_regression", variants=VARIANTS)


def silent(_: Progress) -> None:
    pass


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> RegressionRun:
    return run(TOY, tmp_path_factory.mktemp("toy"), silent)


def test_a_task_has_one_type_and_every_type_has_learners() -> None:
    names = [name for kind in task_types().values() for name in kind.tasks()]
    assert len(names) == len(set(names))
    assert all(kind.tasks() and kind.learners() and kind.presets for kind in task_types().values())


def test_a_run_measures_every_network_of_every_variant(toy: RegressionRun) -> None:
    assert [(row["variant"], row["network"]) for row in toy.rows] == [
        (variant, index) for variant in VARIANTS for index in (0, 1)
    ]
    for row in toy.rows:
        assert all(np.isfinite(float(v)) for k, v in row.items() if k != "variant" and not k.startswith("auroc"))
        assert 0 <= float(row["coverage_0.8"]) <= 1 and float(row["crps"]) > 0
    for variant in VARIANTS:
        found = toy.evaluations[variant]
        assert found["epistemic"].shape == (2, 1000) and (found["epistemic"] > 0).all()
        assert (found["stationarity"] <= np.log(5) + 1e-9).all() and (found["stationarity"] >= 0).all()
    assert toy.recording is not None
    named = contents(toy.recording)
    for variant in VARIANTS:
        kinds = [f"{kind}/{what}" for kind in ("epistemic", "modal", "aleatoric") for what in ("estimated", "true")]
        for part in ("y/training", "y/prediction", *kinds):
            assert named[f"/{variant}/{part}"] == {"x_hundredths"}, part


@pytest.mark.parametrize("agent", sorted(registry.REGRESSORS))
def test_variances_and_nll_are_those_of_pooled_weight_samples(agent: str) -> None:
    """Of targets far from 0 and from unit variance, so that they must be scaled back rightly."""
    rng, context = np.random.default_rng(0), tiny_context(agent, scale=50.0, shift=300.0)
    regressor = registry.make_regressor(agent, context)
    regressor.train(2)
    inputs = rng.normal(size=(2, 20, 1))
    said, pooled = regressor.predict(inputs, rng), regressor.pooled(inputs)
    weights = pooled.weights[..., None]
    mean = (weights * pooled.means).sum(axis=-2, keepdims=True)
    variance = (weights * (pooled.sigmas**2 + (pooled.means - mean) ** 2)).sum(axis=-2)
    np.testing.assert_allclose(said.epistemic + said.aleatoric + said.modal, variance, rtol=1e-3)
    np.testing.assert_allclose(said.mean, mean[..., 0, :], rtol=1e-5)
    assert 10.0 < np.sqrt(variance).mean() < 250.0 and abs(mean.mean() - 300.0) < 100.0
    np.testing.assert_allclose(said.nll, log_score(pooled, said.prediction), atol=1e-3)
    drawn = (said.drawn - mean) / np.sqrt(variance)[..., None, :]  # [E, N, S, D]
    assert drawn.shape == (2, 20, 16, 1) and abs(drawn.mean()) < 0.2 and abs(drawn.var() - 1.0) < 0.25
    assert len(np.unique(drawn)) == drawn.size


def tiny_context(agent: str, scale: float, shift: float) -> RegressorContext:
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(64, 1))
    data = RegressionData(inputs=inputs, targets=shift + scale * (np.sin(inputs) + 0.3 * rng.normal(size=(64, 1))))
    overrides = {**dict(_overrides(agent)), "batch_size": 32}
    return RegressorContext(
        datasets=(data, data), seeds=(SeedTree(0), SeedTree(1)), hyperparameters="minimal", overrides=overrides
    )


class Knowing:
    """Says one thing everywhere, and knows how wrong that is: its epistemic variance, and the negative of its modal."""

    def predict(self, inputs: np.ndarray, rng: np.random.Generator) -> Prediction:
        prediction = np.zeros((*inputs.shape[:2], 1))
        toy = registry.regression("toy_regression")
        wrong = np.stack([toy.errors("base", *pair) for pair in zip(inputs, prediction, strict=True)])[..., None]
        constant = np.zeros(wrong.shape)
        return Prediction(
            prediction=prediction, mean=prediction, epistemic=wrong, aleatoric=constant, modal=-wrong,
            stationarity=constant[..., 0], sampled_variance=constant[..., 0], nll=-wrong[..., 0],
            predictive=self.pooled(inputs), drawn=prediction[:, :, None],
        )  # fmt: skip

    def pooled(self, inputs: np.ndarray) -> Mixtures:
        shape = (*inputs.shape[:2], 1)
        return Mixtures(weights=np.ones(shape), means=np.zeros((*shape, 1)), sigmas=np.full((*shape, 1), 1e6))


def test_errors_are_paired_with_the_scores_of_the_same_points() -> None:
    task, networks = registry.regression("toy_regression"), (SeedTree(0), SeedTree(1))
    rows, arrays = calibrate(task, Knowing(), "base", networks, points=60, rng=np.random.default_rng(0))
    assert arrays["error"].shape == (2, 60) and not np.array_equal(*arrays["error"])
    for row in rows:
        assert 0.0 < row["wrong"] < 1.0
        assert row["auroc_epistemic"] == 1.0 and row["auroc_modal"] == row["auroc_nll"] == 0.0
        assert row["auroc_total"] == row["auroc_aleatoric"] == row["auroc_stationarity"] == 0.5
        assert row["coverage_0.5"] == 1.0, "so wide a prediction has every outcome near its median"


class _Killed(Exception):
    pass


@pytest.mark.parametrize("agent", sorted(registry.REGRESSORS))
def test_interrupted_and_resumed_is_uninterrupted(agent: str, tmp_path: Path) -> None:
    spec = tiny(
        "toy_regression", agent, variants=("low_data", "base", "high_noise"), test_points=5, networks=1, recorded=False
    )
    told_whole: list[Progress] = []
    whole = run(spec, tmp_path / "whole", told_whole.append)
    for after in (2, 3, 9):  # in the first variant, the second and the third
        told = iter(range(after))

        def observe(_: Progress, told: Any = told) -> None:
            if next(told, None) is None:
                raise _Killed

        with pytest.raises(_Killed):
            run(spec, tmp_path / "parts", observe)
    told_after: list[Progress] = []
    parts = run(spec, tmp_path / "parts", told_after.append)
    assert 0 < told_whole[0].done < told_after[0].done, "it must have gone on, not begun anew"
    for mine, theirs in zip(whole.rows, parts.rows, strict=True):
        for name in set(mine) - {"train_cpu_s", "measure_cpu_s"}:
            assert mine[name] == theirs[name] or (np.isnan(mine[name]) and np.isnan(theirs[name])), name
    assert list(parts.evaluations) == list(whole.evaluations) == list(spec.protocol.variants)
    assert (parts.folder / "evaluation.npz").read_bytes() == (whole.folder / "evaluation.npz").read_bytes()


def test_runs_of_other_settings_are_not_averaged(toy: RegressionRun, tmp_path: Path) -> None:
    """As where ``auto`` settled on another precision on another machine."""
    two = replace(TOY.protocol, seeds=(0, 1))
    facts = {"protocol": two, "environment": {}, "folder": tmp_path, "wall_s": 0.0}
    same = replace(toy, seed=1, folder=tmp_path / "seed_1")
    assert RegressionResult(runs=(toy, same), **facts).of("mc_dropout") == (toy, same)
    other = replace(same, settings={**toy.settings, "precision": "float64"})
    with pytest.raises(ArtefactError, match=r"ran with precision '.*' and .*seed_1 with 'float64'"):
        RegressionResult(runs=(toy, other), **facts)


def test_what_regressors_leave_is_not_planned_with(toy: RegressionRun, tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="is of a regression task, in which no agent acts"):
        load_trained(toy.folder)
    with pytest.raises(ArtefactError, match="Task 'toy_regression' is of a regression task"):
        why_report(None, root=tmp_path, task="toy_regression", encoder=None)


def test_a_finished_run_is_only_read(toy: RegressionRun) -> None:
    told: list[Progress] = []
    assert run(TOY, toy.folder, told.append).rows == toy.rows
    assert told == []


def test_a_damaged_result_is_named(toy: RegressionRun, tmp_path: Path) -> None:
    copy = shutil.copytree(toy.folder, tmp_path / "copy")
    (copy / "metrics.csv").write_text("variant,network\n")
    with pytest.raises(ArtefactError, match=r"metrics.csv is not as the run left it"):
        run(TOY, copy, silent)


def test_a_page_shows_every_table_and_figure(toy: RegressionRun, tmp_path: Path) -> None:
    facts = {"protocol": TOY.protocol, "environment": {}, "folder": tmp_path, "wall_s": 1.0}
    page = write_report(RegressionResult(runs=(toy,), **facts))
    html = page.read_text()
    assert html.count("data:image/png;base64") == len(list(page.parent.glob("*.png"))) > 0
    for name in ("results", "calibration", "auroc"):
        assert (page.parent / f"{name}.csv").stat().st_size > 50
    assert "Calibration" in html and ">nan" not in html


@pytest.mark.slow
def test_the_command_ends_in_a_table_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [f"{name}={value}".replace(" ", "") for name, value in _overrides("mc_dropout")]
    words = [
        "bench", "--task", "robot_ik", "--preset", "smoke", "--agents", "mc_dropout", "--variants", "1000",
        "--networks", "1", "--workers", "1", "--out", str(tmp_path), "--set", *settings,
    ]  # fmt: skip
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "MC dropout, 1000" in said and "thesis, 1000" in said and "3.89 (0.67)" in said
    (folder,) = (tmp_path / "robot_ik").iterdir()
    report = folder / "report"
    html = (report / "index.html").read_text()
    assert "Table 4.1" in html and html.count("data:image/png;base64") == 4 and "unreachable" in html
    for name in ("results", "table_4_1", "ratio_to_random", "disc", "disc_ratio_to_random", "calibration", "auroc"):
        assert (report / f"{name}.csv").stat().st_size > 50
    assert (report / "report.md").stat().st_size > 1000
    recording = folder / "mc_dropout" / "seed_0" / "recording.rrd"
    named = contents(recording)
    for part in ("candidates", "chosen", "outside", "error_line", "error", "text"):
        assert named[f"/choice/{part}"] >= {"sim_time", "choice"}, part
    assert min(times(recording, "/choice/text", "choice")) == 1, "counted as its words do"
    assert any(path.startswith("/scene") for path in named)
    assert main(words) == 0  # nothing is missing: the same table again, from the files
    notice, *again = capsys.readouterr().out.splitlines()
    assert notice == f"All runs lie in {folder} already; nothing was run."
    assert again[:8] == said.splitlines()[:8]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--task", "robot_ik", "--variants", "5"], "a number of samples in [20, 1000000], such as 2000, not '5'"),
        (["--task", "toy_regression", "--variants", "bse"], "No variant of toy_regression 'bse'. Did you mean 'base'?"),
        (["--task", "toy_regression", "--agents", "dqn"], "No regressor 'dqn'. Known: mc_dropout, ensemble."),
        (["--task", "toy_regression", "--networks", "0"], "networks is 0; it must lie in [1, 1000]."),
        (["--task", "toy_regression", "--budgets", "5"], "toy_regression takes no --budgets; leave it out."),
        (["--task", "toy_regression", "--set", "weight_samples=1"], "Setting weight_samples is 1; it must lie in [2,"),
        (["--task", "toy_regression", "--set", "dropout=0.96"], "Setting dropout is 0.96; it must be 0 or lie in"),
        (["--task", "toy_regression", "--set", "batch_size=1"], "batch_size is 1; it must lie in [8, 1e+06]: "),
        (["--task", "toy_regression", "--set", "members=1"], "Settings members is 1 and dropout is 0: all weight"),
        (["--task", "toy_regression", "--set", "hidden=[64]"], "dropout acts between hidden layers, so it needs at"),
    ],
)  # fmt: skip
def test_wrong_words_get_one_line_and_write_nothing(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", *words, "--out", str(tmp_path / "runs")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert sentence in line
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("name", "epochs"), [("minimal", 4), ("fast", 120), ("published", 300)])
def test_an_ensemble_is_compared_fairly_with_one_network(name: str, epochs: int) -> None:
    """It never costs more; dropout is of the one, members of the other; published, both sample as many values."""
    one, ensemble = regressor_settings.resolve_all(name, {"dropout": 0.1})
    assert ensemble.epochs == epochs and ensemble.epochs * ensemble.members <= one.epochs
    assert (one.dropout, one.members, ensemble.dropout) == (0.1, 1, 0.0)
    if name == "published":
        assert ensemble.members * ensemble.divergence_draws == one.weight_samples * one.divergence_draws


@pytest.mark.parametrize(("batch_size", "updates"), [(None, 1), (600, 1), (250, 3), (8, 75)])
def test_an_epoch_takes_the_fewest_batches_of_at_most_that_size(batch_size: int | None, updates: int) -> None:
    data = RegressionData(inputs=np.linspace(-1, 1, 600)[:, None], targets=np.ones((600, 1)))
    settings = {"hidden": (4, 4), "components": 2, "batch_size": batch_size}
    context = RegressorContext(datasets=(data,), seeds=(SeedTree(0),), overrides=settings)
    regressor = registry.make_regressor("mc_dropout", context)
    regressor.train(2)
    assert regressor.state().values["batches"] == 2 * updates


def test_an_ensembles_two_distributions_are_one_and_score_alike(tmp_path: Path) -> None:
    """Members side by side are what it predicts with; scored at the same points, both must have one CRPS."""
    found = run(
        tiny("toy_regression", "ensemble", variants=("base",), test_points=80, recorded=False), tmp_path, silent
    )
    pair = PairResult("ensemble", "base", (found,))
    alone, pooled = pair.values("crps_shared"), pair.values("pooled_crps_shared")
    np.testing.assert_allclose(alone, pooled, rtol=1e-5)
    assert not np.allclose(pair.values("crps"), pooled, rtol=1e-3), "all 80 points are others than the first 50"


def data(rows: int, value: float = 1.0) -> RegressionData:
    return RegressionData(inputs=np.zeros((rows, 1)), targets=np.full((rows, 1), value))


@pytest.mark.parametrize(
    ("datasets", "sentence"),
    [
        ((data(5), data(4)), "Dataset 1 has inputs and targets of shapes"),
        ((data(5), data(5, np.nan)), "Dataset 1 holds values that are not finite"),
        ((data(5),), "a seed for each, not 1 and 2"),
    ],
)
def test_a_regressor_refuses_data_it_cannot_learn_from(datasets: tuple[RegressionData, ...], sentence: str) -> None:
    with pytest.raises(InvalidValueError, match=sentence):
        registry.make_regressor("mc_dropout", RegressorContext(datasets=datasets, seeds=(SeedTree(0), SeedTree(1))))


def test_a_regressor_refuses_inputs_of_another_shape() -> None:
    sound = registry.make_regressor("mc_dropout", RegressorContext(datasets=(data(5),), seeds=(SeedTree(0),)))
    with pytest.raises(InvalidValueError, match=r"N at least 1, not \(1, 0, 1\)"):
        sound.predict(np.zeros((1, 0, 1)), np.random.default_rng(0))


@pytest.mark.parametrize("agent", sorted(registry.REGRESSORS))
def test_regressors_learn_two_branches_refuse_foreign_states(agent: str) -> None:
    """Chance: |y| is uniform in [0.5, 1.5], so a network that ignores x cannot go below log 2 = 0.69 nats."""
    rng = np.random.default_rng(0)

    def branches(count: int) -> RegressionData:
        x = rng.uniform(-1, 1, (count, 1))
        y = np.where(rng.random((count, 1)) < 0.5, 1.0, -1.0) * (1 + 0.5 * x) + 0.05 * rng.standard_normal((count, 1))
        return RegressionData(inputs=x, targets=y)

    settings = {"epochs": 40, "hidden": (32, 32), "components": 4, "batch_size": 50, "learning_rate": 1e-2}
    context = RegressorContext(datasets=(branches(600),), seeds=(SeedTree(5),), overrides=settings)
    regressor = registry.make_regressor(agent, context)
    regressor.train(40)
    test = branches(200)
    said = regressor.predict(test.inputs[None], rng)
    assert log_score(said.predictive.map(itemgetter(0)), test.targets).mean() < 0.2
    truth = (1 + 0.5 * test.inputs[:, 0]) ** 2  # half the distance between the branches, squared
    assert np.corrcoef(said.modal[0, :, 0], truth)[0, 1] > 0.3  # chance: 0
    state = regressor.state()
    with pytest.raises(ArtefactError):
        regressor.restore(AgentState(arrays={**state.arrays, "other": np.zeros(1)}, values=state.values))


def test_claims_and_ratios_by_hand() -> None:
    values = np.array([2.0, 3.0, 4.0])
    assert toy_regression.holds(values, "≥ 3") == 2
    assert toy_regression.holds(values, "≤ 3") == toy_regression.holds(values, "≤ 2") + 1 == 2
    estimate = robot_ik.ratio_to_random(np.array([1.8, 2.0, 2.2]), np.array([3.6, 4.0, 4.4]))
    assert estimate[:3] == pytest.approx((0.5, 0.5, 0.5))  # every network halves its own random error
    assert set(SCORES) >= {"epistemic", "aleatoric", "modal", "stationarity", "nll", "sampled_component"}


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (9.999, 3, "10.0"), (1234.5, 3, "1234"), (0.0042, 3, "0.004"), (0.004, 2, "4.0e\u221203"), (0.0, 3, "0.000"),
        (-3.14159, 3, "\u22123.14"), (123456.0, 3, "1.23e+05"), (math.nan, 3, "–"),
    ],
)  # fmt: skip
def test_numbers_show_what_there_is(value: float, digits: int, text: str) -> None:
    assert number(value, digits) == text


def test_lists_of_sessions_are_rows_not_python() -> None:
    facts = {"seeds": [0, 1], "sessions": [{"wall_s": 1.0, "changed": {}}, {"wall_s": 2.0, "changed": {"commit": "a"}}]}
    assert flat("", facts) == [
        ("seeds", "0; 1"), ("sessions.1.wall_s", "1.0"),
        ("sessions.2.wall_s", "2.0"), ("sessions.2.changed.commit", "a"),
    ]  # fmt: skip


def test_one_regressor_with_two_settings_in_one_bench(tmp_path: Path) -> None:
    protocol, _ = plan(
        "toy_regression",
        "smoke",
        agents=("mc_dropout:epochs=6", "mc_dropout"),
        overrides=_TINY,
        variants=("base",),
        test_points=2,
        recorded=False,
    )
    assert protocol.agents == ("mc_dropout:epochs=6", "mc_dropout")
    runs = [run(RunSpec(protocol=protocol, agent=a, seed=0), tmp_path / a[-1], silent) for a in protocol.agents]
    assert [each.settings["epochs"] for each in runs] == [6, 4]
