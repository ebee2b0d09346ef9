"""Three formats hold the same episodes to the bit, in the layouts that other people's readers expect."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import minari
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from small_runs import FORMATS, collected, exact, written

from imagine_bench import registry
from imagine_bench.arrays import content_hash
from imagine_bench.data import lerobot
from imagine_bench.data.folder import read_apart, read_dataset, require_fits
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.running.collect import describe
from imagine_bench.store.files import make_folder, write_json

_DATA = "data/chunk-000/file-000.parquet"


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_gives_back_every_bit(tmp_path: Path, format: str) -> None:
    episodes, apart, card = collected()
    dataset = written(tmp_path / "set", format)
    found = read_dataset(tmp_path / "set")
    assert exact(found.episodes.arrays()) == exact(episodes.arrays()) and found.format == format
    assert found.card is not None and {**card, "format": format}.items() <= found.card.items()
    assert found.identity == dataset.identity == f"mixed-6@{episodes.hash[:12]}"
    assert {name: set(arrays) for name, arrays in read_apart(found).items()} == {"privileged": {"macrostates", "seeds"}}
    assert np.array_equal(read_apart(found)["privileged"]["macrostates"], apart["privileged"]["macrostates"])
    assert not list(tmp_path.glob(".*")), "nothing half-written is left"


def test_a_hash_stands_for_the_content_alone() -> None:
    episodes = collected()[0]
    for name in ("frames", "rewards", "success", "action_masks"):
        changed = getattr(episodes, name).copy()
        changed[-1] = 1 - changed[-1] if name != "success" else ~changed[-1]
        assert dataclasses.replace(episodes, **{name: changed}).hash != episodes.hash
    assert content_hash(dict(reversed(episodes.arrays().items()))) == episodes.hash, "in any order"


# --- Minari ----------------------------------------------------------------------------------------------------------


def test_minari_loads_the_set_and_its_environment(tmp_path: Path) -> None:
    written(tmp_path / "set", "minari")
    found = minari.MinariDataset(tmp_path / "set" / "arrow_puzzle-mixed-v0" / "data")
    assert found.id == "arrow_puzzle-mixed-v0"
    (first, *_) = found.iterate_episodes()
    episodes = collected()[0]
    assert np.array_equal(first.observations, episodes.frames[episodes.steps(0)[1]]), "lossless: no JPEG"
    env = found.recover_environment()
    assert env.spec is not None and env.spec.id == "imagine_bench/ArrowPuzzle-v0"
    assert env.spec.kwargs.items() >= {"execution": "kinematic", "appearance": "mild"}.items()
    env.close()


def test_a_set_of_others_is_read_without_a_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Minari's own recorder writes it: every key of info, and no file of ours."""
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic") as env:
        buffers = []
        for seed in range(2):
            frame, info = env.reset(seed=seed)
            frames, infos, rewards, ends, over = [frame], [info], [], [], False
            while not over:
                frame, reward, terminated, truncated, info = env.step(0)
                over = terminated or truncated
                frames, infos = [*frames, frame], [*infos, info]
                rewards, ends = [*rewards, reward], [*ends, (terminated, truncated)]
            told = {name: [each[name] for each in infos] for name in infos[0]}
            terminations, truncations = map(list, zip(*ends, strict=True))
            buffers.append(EpisodeBuffer(
                observations=np.stack(frames), actions=[0] * len(rewards), rewards=rewards,
                terminations=terminations, truncations=truncations, infos=told,
            ))  # fmt: skip
        with pytest.warns(UserWarning):
            minari.create_dataset_from_buffers("mine-v3", buffers, env=env, data_format="arrow", jpeg_encoding=False)
    for folder in (tmp_path, tmp_path / "mine-v3"):
        found = read_dataset(folder)
        assert found.card is None and found.identity.startswith("foreign-2@")
        assert np.array_equal(found.episodes.frames[: len(buffers[0]) + 1], buffers[0].observations)
        said = describe(found)
        assert (
            f"2 of {sum(map(len, buffers))} transitions, as minari\n" in said
            and "none: it is not of this suite" in said
        )
        require_fits(found, registry.task("arrow_puzzle"), "strong")  # nothing says how its frames look
        with pytest.raises(InvalidValueError, match="is of a task with 6 macro-actions; give one of pick_place"):
            require_fits(found, registry.task("pick_place"), "strong")


# --- LeRobot ---------------------------------------------------------------------------------------------------------


def test_a_folder_of_several_sets_is_not_read_as_one(tmp_path: Path) -> None:
    for name in ("one", "other"):
        (made,) = written(tmp_path / name, "minari", episodes=1).folder.glob("*/data")
        shutil.copytree(made, tmp_path / "sets" / name / "data")
    with pytest.raises(ArtefactError, match=r"2 datasets \(one/data/metadata.json, other/data/metadata.json\)"):
        read_dataset(tmp_path / "sets")
    assert len(read_dataset(tmp_path / "sets" / "one").episodes) == 1


def test_the_layout_is_lerobots(tmp_path: Path) -> None:
    """The needs of LeRobot's own reader; those of 0.4.4 and 0.6.1 were run on such a set, but install only apart.

    ``tests/whole`` shows all columns. Here episodes are cut off after a macro-action, but for those that end.
    """
    written(tmp_path / "set", "lerobot", policy="uniform")
    folder = tmp_path / "set"
    info = json.loads((folder / "meta/info.json").read_text())
    table = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert info["codebase_version"] == "v3.0" and set(table.schema.names) == set(info["features"])
    assert np.array_equal(table["next.done"].to_numpy(), np.diff(table["episode_index"].to_numpy(), append=99) > 0)
    told = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert told["observation.image"] == {"_type": "Image"} and told["action"] == {"dtype": "float32", "_type": "Value"}
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    (index,) = json.loads(tasks.schema.metadata[b"pandas"])["index_columns"]
    assert tasks.to_pydict() == {"task_index": [0], index: [registry.task("arrow_puzzle").description]}


def told(episodes: Episodes, index: int) -> object:
    """All that a set says of one of its episodes."""
    steps, frames = episodes.steps(index)
    by_step = [getattr(episodes, name)[steps] for name in ("actions", "rewards", "terminated", "truncated")]
    return exact([*by_step, episodes.frames[frames], episodes.action_masks[frames], episodes.success[index]])


def edited(out: Path, *chosen: tuple[Path, Sequence[int]]) -> None:
    """Some episodes of some sets as one, as LeRobot's own tools delete, split and merge: they renumber columns."""
    kept = []
    for folder, episodes in chosen:
        table = pq.read_table(folder / _DATA)
        kept += [table.filter(pc.equal(table["episode_index"], episode)) for episode in episodes]
    table = pa.concat_tables(kept)
    numbers = {"episode_index": np.repeat(np.arange(len(kept)), list(map(len, kept))), "index": np.arange(len(table))}
    for name, column in numbers.items():
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(column))
    make_folder((out / _DATA).parent)
    pq.write_table(table, out / _DATA)
    info = json.loads((chosen[0][0] / "meta/info.json").read_text())
    write_json(
        make_folder(out / "meta") / "info.json", {**info, "total_frames": len(table), "total_episodes": len(kept)}
    )


@pytest.mark.parametrize(
    "which", [((0, 2, 5), ()), ((3, 4, 5), ()), (range(6), range(4))], ids=["delete", "split", "merge"]
)
def test_what_lerobots_tools_made_is_read_with_the_last_frames_copied(
    tmp_path: Path, which: tuple[Sequence[int], Sequence[int]]
) -> None:
    """LeRobot 0.4.4's tools turned such sets into the ones made here; they leave ``final_frames.parquet`` behind."""
    wanted = []
    for seed, episodes in enumerate(which):
        written(tmp_path / f"set{seed}", "lerobot", seed=seed)
        wanted += [told(collected(seed=seed)[0], episode) for episode in episodes]
    edited(tmp_path / "out", *((tmp_path / f"set{seed}", episodes) for seed, episodes in enumerate(which)))
    with pytest.raises(ArtefactError, match="copy it from the dataset that this one was made from; of several"):
        read_dataset(tmp_path / "out")
    for seed in range(2):
        shutil.copy(tmp_path / f"set{seed}/final_frames.parquet", tmp_path / f"out/final_frames_{seed}.parquet")
    found = read_dataset(tmp_path / "out").episodes
    assert [told(found, episode) for episode in range(len(found))] == wanted and wanted


def test_episodes_that_differ_late_keep_their_order(tmp_path: Path) -> None:
    written(tmp_path / "set", "lerobot")
    edited(tmp_path / "out", *((tmp_path / "set", range(6)),) * 2)
    ends = pq.read_table(tmp_path / "set/final_frames.parquet")
    column = ends.column_names.index("observation.image")
    others = ends.set_column(column, ends.field(column), ends[column].take([5, 4, 3, 2, 1, 0]))
    for number, table in enumerate((ends, others)):
        pq.write_table(table, tmp_path / f"out/final_frames_{number}.parquet")
    found, honest = read_dataset(tmp_path / "out").episodes, collected()[0]
    last = [found.frames[found.steps(index)[1]][-1] for index in range(12)]
    wanted = [honest.frames[honest.steps(index)[1]][-1] for index in (*range(6), *range(5, -1, -1))]
    np.testing.assert_array_equal(last, wanted)


def test_last_frames_without_digests_are_read_in_order(tmp_path: Path) -> None:
    written(tmp_path / "set", "lerobot")
    path = tmp_path / "set/final_frames.parquet"
    pq.write_table(pq.read_table(path).drop_columns("episode_digest"), path)
    assert read_dataset(tmp_path / "set").episodes.hash == collected()[0].hash


def test_statistics_are_those_of_the_arrays(tmp_path: Path) -> None:
    """Of the whole set, and of each episode."""
    written(tmp_path / "set", "lerobot")
    episodes, folder = collected()[0], tmp_path / "set/meta"
    every = slice(None)
    told = [(every, json.loads((folder / "stats.json").read_text()))]
    for index, row in enumerate(pq.read_table(folder / "episodes/chunk-000/file-000.parquet").to_pylist()):
        steps, _ = episodes.steps(index)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (steps.start, steps.stop)
        names = ("observation.image", "next.reward")
        which = ("min", "max", "mean", "std", "count")
        told.append((steps, {name: {each: row[f"stats/{name}/{each}"] for each in which} for name in names}))
    for steps, stats in told:
        frames = episodes.frames[episodes.rows[0][steps]].reshape(-1, 3) / 255
        for values, name in ((frames, "observation.image"), (episodes.rewards[steps, None], "next.reward")):
            for which in ("min", "max", "mean", "std"):
                found = np.ravel(stats[name][which])
                assert np.allclose(found, getattr(values, which)(axis=0), rtol=1e-12, atol=1e-12), (name, which)
            assert stats[name]["count"] == [len(episodes.actions[steps])]


def test_large_sets_lie_in_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot, "_ROWS", 5)
    monkeypatch.setattr(lerobot, "_FILES", 2)
    written(tmp_path / "set", "lerobot")
    listed = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    places = set()
    for row in listed:
        place = (row["data/chunk_index"], row["data/file_index"])
        there = pq.read_table(tmp_path / "set/data/chunk-{:03d}/file-{:03d}.parquet".format(*place))
        assert row["episode_index"] in there["episode_index"].to_pylist()
        places.add(place)
    assert len(places) > 2 and max(places)[0] > 0 and max(file for _, file in places) == 1
    assert read_dataset(tmp_path / "set").episodes.hash == collected()[0].hash


def test_nothing_a_learner_reads_holds_macrostates(tmp_path: Path) -> None:
    for format in FORMATS:
        written(tmp_path / format, format)
    assert set(np.load(tmp_path / "npz/episodes.npz").files) == {field.name for field in dataclasses.fields(Episodes)}
    assert not [name for name in pq.read_table(tmp_path / "lerobot" / _DATA).schema.names if "state" in name]
    (data,) = (tmp_path / "minari").glob("*/data")
    assert set(next(iter(minari.MinariDataset(data))).infos) == {"action_mask", "is_success"}
