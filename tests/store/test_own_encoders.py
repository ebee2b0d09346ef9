"""Encoders of worlds that none is bundled for: trained once for the looks of the worlds, whatever their rules."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
from safetensors.numpy import save_file
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, ImagineBenchError, UnableError
from imagine_bench.report.bench import bench_page
from imagine_bench.running.bench import bench, plan
from imagine_bench.store import encoders

LOOK_ALIKE = ("arrows:cubes=2", "arrows:cubes=2,slip=0.2", "arrows:cubes=2,goal=01,coupling=neighbour,shuffle=3")


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """The trained encoders, in order, by something that only leaves a file."""
    made = []

    def retrain(spec, *, recipe, appearance, seed, out):
        made.append((spec.id, recipe, appearance))
        (out / f"{spec.encoder}-{appearance}{'-codes' if recipe == 'codes' else ''}.safetensors").touch()

    load = registry.load
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path))
    monkeypatch.setattr(registry, "load", lambda name: retrain if name == encoders.TRAIN else load(name))
    return made


def test_worlds_that_look_alike_share_one_training(trained, tmp_path, capsys):
    places = {encoders.own(registry.task(name), "clean", "codes") for name in (*LOOK_ALIKE, *LOOK_ALIKE)}
    assert trained == [(LOOK_ALIKE[0], "codes", "clean")]
    (place,) = places
    assert place.is_file() and place.is_relative_to(tmp_path)
    assert capsys.readouterr().out.count("one is trained") == 1


def test_what_looks_otherwise_is_trained_for_itself(trained):
    wanted = [
        ("arrows:cubes=2", "clean", "codes"),
        ("arrows:cubes=2", "clean", "latents"),
        ("arrows:cubes=2", "mild", "codes"),
        ("arrows:cubes=4", "clean", "codes"),
        ("arrows:cubes=2,gesture=first", "clean", "codes"),
    ]
    places = {encoders.own(registry.task(name), appearance, kind) for name, appearance, kind in wanted}
    assert len(places) == len(wanted) == len(trained)
    for settings in ({"config_group": "chapter_3"}, {"preprocessing": "small_rgb"}):  # encoders are trained otherwise
        spec = dataclasses.replace(registry.task("arrows:cubes=2"), **settings)
        assert encoders.cached(spec, "clean", "codes") not in places


@pytest.mark.parametrize(
    ("agent", "option", "reason"),
    [
        ("dqn", {"queries": 1}, "cannot query an oracle"),
        ("dqn_codes", {"queries": 1}, "cannot query an oracle"),
        ("dqn", {"after": ("arrows:cubes=2,goal=01",)}, "has no model of the world"),
        ("sb3_dqn_latents", {"demonstrations": 1}, "trains in a loop of its own"),
        ("sb3_dqn_latents", {"feedback": 1.0}, "trains in a loop of its own"),
    ],
)
def test_no_encoder_is_trained_for_an_unable_agent(trained, agent, option, reason):
    with pytest.raises(UnableError, match=reason):
        plan("arrows:cubes=2", "smoke", agents=("random", agent), **option)
    assert not trained
    with pytest.raises(ArtefactError):  # the encoder of this test is an empty file
        plan("arrows:cubes=2", "smoke", agents=("imagination",), demonstrations=1)
    assert trained, "an able agent needs it"


@pytest.mark.parametrize("name", ["arrows", "arrows:slip=0.2", "arrows:goal=012,forbid=none"])
def test_three_cubes_have_the_bundled_one(trained, name):
    place = encoders.own(registry.task(name), "clean", "latents")
    assert place == encoders.bundled()["arrow_puzzle-clean"] and not trained


def test_of_encoders_of_one_name_the_one_with_the_content_is_meant(tmp_path, monkeypatch):
    """Such as those of two worlds, or of a bundled one and one that an earlier version had."""
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path))
    here = [encoders.bundled()["arrow_puzzle-clean"]]
    for folder, of in (("a", "arrow_puzzle-mild"), ("b", "arrow_puzzle-strong")):
        here.append(tmp_path / "encoders" / folder / here[0].name)
        here[-1].parent.mkdir(parents=True)
        shutil.copy(encoders.bundled()[of], here[-1])
    for path in here:
        assert encoders.find(encoders.identity(path)) == path
        assert encoders.card(encoders.identity(path)) == encoders.card_of(path)
    assert encoders.of_name(encoders.identity(here[0])) == here
    assert encoders.find("arrow_puzzle-clean@0123456789ab") is None


@pytest.mark.parametrize(("share", "doubted"), [(0.8999, True), (0.9, False)])
def test_an_encoder_that_reads_few_frames_right_is_named(tmp_path, share, doubted):
    path = tmp_path / "theirs.safetensors"
    save_file({"a": np.zeros(1)}, path, {"card": json.dumps({"probe": {"mlp": share}})})
    card = encoders.card_of(path)
    assert bool(encoders.reading_warning("theirs", card)) == bool(encoders.mark(encoders.low_share(card))) == doubted


@pytest.mark.parametrize("own", [False, True])
def test_a_bench_and_its_report_name_an_encoder_that_misreads(tmp_path, capsys, own):
    """The bundled codes of the strongest look read a ninth of its frames, also from a file of one's own."""
    mine = tmp_path / "mine.safetensors"
    shutil.copy(encoders.bundled()["arrow_puzzle-strong-codes"], mine)
    few = {"budgets": (1,), "evaluation_episodes": 1, "open_loop_starts": 0, "recorded_episodes": 0}
    agents = ("factored:given",)
    given = str(mine) if own else None
    wanted, paths = plan(
        "arrow_puzzle", "smoke", agents=agents, appearance="strong", execution="kinematic", encoder=given, **few
    )
    result = bench(wanted, paths, root=tmp_path, launcher=Inline())
    mine.unlink()
    assert "reads only 11.5% of new frames right" in capsys.readouterr().out
    page = bench_page(result)
    assert any("reads only 11.5% of new frames right" in line for line in page.answers)
    assert "(encoder reads 11.5%)" in page.summary.partition("chance level")[0]
    (costs,) = (table for section in page.sections for table in section.tables if table.name == "cost")
    assert "8,000" in costs.rows[0], "frames that it was made of"


@pytest.mark.parametrize("kind", ["latents", "codes"])
def test_an_artefact_says_itself_what_it_gives(tmp_path, kind):
    """Without the card that lies beside it, and of a bare file of tensors nothing is assumed."""
    name = "arrow_puzzle-clean-codes" if kind == "codes" else "arrow_puzzle-clean"
    path = tmp_path / "alone.safetensors"
    shutil.copy(encoders.bundled()[name], path)
    assert encoders.kind(path) == kind
    save_file({"a": np.zeros(1)}, path)
    with pytest.raises(ArtefactError, match=r"alone\.safetensors is not an encoder with a card"):
        encoders.kind(path)


@pytest.mark.parametrize(
    ("given", "home", "sentence"),
    [
        (None, "/dev/null/nowhere", "A folder of encoders may be named in IMAGINE_BENCH_CACHE"),
        ("~nobody_at_all/x", "/tmp", "the system knows no such home folder; give a path without '~'"),
        (None, None, "This user has no home folder; name one for encoders in IMAGINE_BENCH_CACHE"),
    ],
)
def test_a_cache_that_cannot_be_names_the_way_out(monkeypatch, given, home, sentence):
    for name, value in (("IMAGINE_BENCH_CACHE", given), ("HOME", home), ("XDG_CACHE_HOME", None)):
        monkeypatch.delenv(name, raising=False) if value is None else monkeypatch.setenv(name, value)
    monkeypatch.setattr("pwd.getpwuid", dict[int, str]().__getitem__)  # as in a container whose user has no name
    with pytest.raises(ImagineBenchError, match=sentence):
        encoders.own(registry.task("arrows:cubes=2"), "clean")
