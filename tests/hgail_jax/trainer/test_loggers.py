"""What loggers were given, read back from their files without them."""

import csv
import dataclasses
import glob
import json
import os
import struct
import sys
import time
import types
from pathlib import Path

import imageio
import numpy as np
import pytest
from scipy import stats

from hgail_jax import Trainer, TrainOptions
from hgail_jax.trainer import loop
from hgail_jax.trainer.folder import open_run_folder
from hgail_jax.trainer.loggers import check_loggers, scalars
from hgail_jax.trainer.train_options import plan
from hgail_jax.trainer.training import train_run
from tests.hgail_jax.trainer.stand_in import train_without_a_compiler
from tests.hgail_jax.trainer.test_checkpoint import saved_in
from tests.hgail_jax.trainer.test_trainer import After
from tests.support import make_runs_tiny

SMALL = TrainOptions(task="point", seeds=2, num_envs=4, rounds=4)


@pytest.fixture(autouse=True)
def tiny(monkeypatch, tmp_path):
    make_runs_tiny(monkeypatch)
    train_without_a_compiler(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")


def records(path):
    """The records of a TFRecord file, whose frame is a length, its checksum, the content and its checksum."""
    content, at = Path(path).read_bytes(), 0
    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        yield content[at + 12 : at + 12 + length]
        at += 16 + length


def events(folder):
    """The events of a TensorBoard folder in the order in which they were written."""
    from tensorboardX.proto.event_pb2 import Event

    return [Event.FromString(one) for path in sorted(glob.glob(f"{folder}/events*")) for one in records(path)]


def tensorboard_scalars(folder):
    """What TensorBoard shows, by name and step: an event that starts a session drops what comes from its step on."""
    found = {}
    for event in events(folder):
        if event.WhichOneof("what") == "session_log":
            found = {key: value for key, value in found.items() if key[1] < event.step}
        for value in event.summary.value:
            if value.WhichOneof("value") == "simple_value":
                assert (value.tag, event.step) not in found
                found[value.tag, event.step] = value.simple_value
    return found


def blocks(path):
    """The records of a log as LevelDB has it: parts in blocks of 32 KiB; this one has a header of 7 bytes."""
    content, at, record = Path(path).read_bytes(), 7, b""
    assert content.startswith(b":W&B")
    while at + 7 <= len(content):
        if 2**15 - at % 2**15 < 7:  # no room for another part
            at += 2**15 - at % 2**15
            continue
        length, kind = struct.unpack_from("<HB", content, at + 4)
        record += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # the whole, or the last part
            yield record
            record = b""


def wandb_history(folder):
    """The rows of all offline runs in a folder, by the id of the run."""
    from wandb.proto.wandb_internal_pb2 import Record

    runs = {}
    # A run that is resumed within a second has the first folder's name, and "-1".
    for path in sorted(glob.glob(f"{folder}/wandb/offline-run-*/run-*.wandb"), key=os.path.dirname):
        rows = runs.setdefault(Path(path).stem.removeprefix("run-"), [])
        for data in blocks(path):
            record = Record.FromString(data)
            if record.WhichOneof("record_type") == "history":
                rows.append({item.key or "/".join(item.nested_key): item.value_json for item in record.history.item})
    return runs


def table(folder):
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def expected(folder):
    """What a dashboard should show, from metrics.csv: by name and step."""
    rows, found = table(folder), {}
    for index in dict.fromkeys(row["round"] for row in rows):
        of_round = [row for row in rows if row["round"] == index]
        step = int(of_round[0]["env_steps"])
        for name in ("round", "env_steps", "seconds"):
            found[name, step] = float(of_round[0][name])
        for name in set(of_round[0]) - {"seed", "round", "env_steps", "seconds"}:
            values = [float(row[name]) for row in of_round if row[name]]
            found |= {(f"{name}/seed-{row['seed']}", step): float(row[name]) for row in of_round if row[name]}
            if values:
                found[f"{name}/mean", step] = np.mean(values)
            if len(values) > 2:
                low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), max(stats.sem(values), 1e-12))
                found |= {(f"{name}/interval_low", step): low, (f"{name}/interval_high", step): high}
    return found


def same(found, wanted):
    assert set(found) == set(wanted)
    for key, value in wanted.items():
        assert found[key] == pytest.approx(value, rel=1e-4, abs=1e-5), key


def test_dashboards_have_all_of_the_table_and_more():
    options = dataclasses.replace(SMALL, logger="csv,tensorboard,wandb")
    run, frames = plan(options, "cpu"), np.zeros((16, 32, 48, 3), np.uint8)
    with open_run_folder(run, "run", None) as opened:
        summary = train_run(run, opened)
        imageio.mimwrite("run/rollout.mp4", frames, fps=25, macro_block_size=1)
        for logger in opened.loggers:
            logger.film(Path("run/rollout.mp4"))
    folder = Path("run/tensorboard")
    same(tensorboard_scalars(folder), expected(Path("run")))
    values = {value.tag: value for event in events(folder) for value in event.summary.value}
    assert values["curves"].image.encoded_image_string.startswith(b"\x89PNG")
    (text,) = [value for tag, value in values.items() if tag.startswith("settings")]
    settings = json.loads(text.tensor.string_val[0].decode().removeprefix("```json").removesuffix("```"))
    assert settings["config"]["num_envs"] == 4
    assert settings["options"]["logger"] == "csv,tensorboard,wandb"
    final = tensorboard_scalars(folder / "summary")
    assert final["final/success_rate", 0] == pytest.approx(summary["success_rate"]["mean"])
    film = values["film"].image
    assert film.encoded_image_string.startswith(b"GIF8")
    assert (film.height, film.width) == (8, 12)
    (files,) = Path("run/wandb").glob("offline-run-*/files")
    assert {path.suffix for path in (files / "media").rglob("*") if path.is_file()} == {".png", ".mp4"}


@pytest.mark.parametrize("stopped", ["by an event", "killed"])
def test_a_resumed_run_continues_in_the_same_log(monkeypatch, stopped):
    import wandb

    one_second = types.SimpleNamespace(**vars(time) | {"time": lambda: 1.7e9})
    monkeypatch.setattr("tensorboardX.event_file_writer.time", one_second)  # which names the files
    options = {"logger": "csv,tensorboard,wandb", "checkpoint_every": 2}
    first = Trainer(SMALL, out=Path("run"), **options)
    if stopped == "killed":
        with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
            kill_in_round_3(patch)
            first.train()
        assert saved_in(Path("run")) == [2]
        assert len(table(Path("run"))) == 3 * 2  # the third round is logged and not saved
    else:
        assert first.train(After(3)) is None
    wandb.teardown()  # its service, which may still be at the first run, as a process ends that is stopped or killed
    Trainer(SMALL, resume="run", **options).train()
    wandb.teardown()  # by then all is written
    same(tensorboard_scalars("run/tensorboard"), expected(Path("run")))
    ((_, rows),) = wandb_history("run").items()  # one run
    shown = {
        (name, int(float(row["env_steps"]))): float(value)
        for row in rows
        if "env_steps" in row
        for name, value in row.items()
        if not name.startswith(("_", "curves"))
    }
    same({key: value for key, value in shown.items() if key[0] != "seconds"}, without_seconds(expected(Path("run"))))


def without_seconds(found):
    return {key: value for key, value in found.items() if key[0] != "seconds"}


def kill_in_round_3(patch):
    def record(metrics, index, *more):
        if index == 3:
            raise RuntimeError("killed")
        return loop_record(metrics, index, *more)

    loop_record = loop.round_record
    patch.setattr(loop, "round_record", record)


def test_a_log_that_comes_later_has_the_rounds_before_it_too():
    assert Trainer(SMALL, out=Path("run")).train(After(3)) is None
    Trainer(SMALL, resume="run", logger="tensorboard").train()
    steps = {step for _, step in tensorboard_scalars("run/tensorboard")}
    assert len(steps) == 5
    assert len(table(Path("run"))) < 10  # the table is not among the loggers any more


def test_numbers_that_were_not_measured_are_absent():
    record = {"round": 0, "reward": [None] * 3, "distance_l1": [0.5, None, 1.5], "kl": [1.0, 3.0, 5.0]}
    found = scalars(record, first_seed=5)
    half = stats.t.ppf(0.975, 2) * np.std([1.0, 3.0, 5.0], ddof=1) / np.sqrt(3)
    assert found.pop("kl/interval_low") == pytest.approx(3.0 - half)
    assert found.pop("kl/interval_high") == pytest.approx(3.0 + half)
    two = {"distance_l1/seed-5": 0.5, "distance_l1/seed-7": 1.5, "distance_l1/mean": 1.0}  # without an interval
    assert found == {"round": 0, "kl/seed-5": 1.0, "kl/seed-6": 3.0, "kl/seed-7": 5.0, "kl/mean": 3.0} | two


@pytest.mark.parametrize("names", ["", "csv,", "tensorbord", "csv tensorboard"])
def test_an_unknown_logger_is_refused(names):
    with pytest.raises(ValueError, match="choose from csv, tensorboard, wandb"):
        Trainer(SMALL, logger=names)
    assert not list(Path().iterdir())


@pytest.mark.parametrize(("name", "library"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")])
def test_a_missing_library_is_named_with_its_extra(monkeypatch, name, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=rf"the logger {name} needs {library}: pip install 'hgail-jax\[{name}\]'"):
        check_loggers(f"csv,{name}")


def test_a_library_that_nobody_asks_for_is_not_needed(monkeypatch):
    for library in ("tensorboardX", "wandb"):
        monkeypatch.setitem(sys.modules, library, None)
    assert check_loggers("csv") == ("csv",)
