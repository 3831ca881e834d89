"""Blocks behind an image: whole or not there, and known to be cut off."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesmc.errors import CheckpointError, DamagedFileError, FileFormatError
from bayesmc.storage import (
    Blocks,
    CheckpointFile,
    Group,
    Saver,
    Variable,
    blocks,
    open_image,
    packed,
    unpacked,
    write_image,
)

pytest.importorskip("h5netcdf", reason="needs the extra netcdf")


def begun(path: Path, count: int, size: int = 10) -> Saver:
    write_image(path, {}, packed({"header": None}), {"kind": "run"})
    saver = Saver(CheckpointFile(path, every=0), {})
    for k in range(count):
        saver.save({"k": k}, {"k": k, "x": np.full(size, k)})
    return saver


def test_blocks_are_there_again(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    assert begun(path, 3).due()
    again = Saver(CheckpointFile(path, every=60), {}, alone=False)
    assert [r["k"] for r in again.rows()] == [0, 1, 2]
    assert again.state["k"] == 2
    assert not again.due()


def test_a_block_on_its_way_is_none(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    begun(path, 2)
    with open(path, "ab") as file:
        file.write(b"bmcBLOCK" + b"\1" * 500)
    saver = Saver(CheckpointFile(path), {})
    assert saver.state["k"] == 1
    saver.save({"k": 2}, {"k": 2})
    assert [r["k"] for r in Saver(CheckpointFile(path), {}, alone=False).rows()] == [0, 1, 2]


def test_every_cut_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    begun(path, 3)
    whole, image = path.read_bytes(), Blocks(path).image
    for at in (*range(image.size, image.end, 37), image.end - 1):
        path.write_bytes(whole[:at])
        with pytest.raises(DamagedFileError, match="cut off") as caught:
            Blocks(path)
        found = Blocks(path, repair=True)
        assert found.count == caught.value.blocks < 3
        assert len(list(found.rows())) == found.count
    path.write_bytes(whole[: image.size // 2])
    with pytest.raises(DamagedFileError, match="before its first block"):
        Blocks(path)


def test_bytes_that_changed_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    begun(path, 3)
    data = bytearray(path.read_bytes())
    data[Blocks(path).blocks[3].at + blocks.SIZE + 20] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(DamagedFileError, match="One of its blocks is whole"):
        Blocks(path)


def test_states_that_are_void_do_not_pile_up(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(blocks, "_VOID", 10_000)
    path = tmp_path / "run.nc"
    begun(path, 60, size=1000)
    assert path.stat().st_size < 60_000
    again = Saver(CheckpointFile(path), {}, alone=False)
    assert [r["k"] for r in again.rows()] == list(range(60))
    assert again.state["k"] == 59


def test_two_runs_do_not_share_a_file(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    first = begun(path, 1)
    with pytest.raises(CheckpointError, match="another process"):
        Saver(CheckpointFile(path), {})
    del first
    Saver(CheckpointFile(path), {})


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not mine")
    with pytest.raises(FileFormatError, match="no NetCDF-4"):
        Blocks(path)
    with pytest.raises(FileNotFoundError):
        Blocks(tmp_path / "nowhere.nc")
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_every_changed_byte_of_an_image_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "answer.nc"
    group = Group({"x": Variable(("draw",), np.arange(50.0))})
    write_image(path, {"posterior": group}, packed({"x": np.arange(20)}), {"kind": "answer"})
    whole = path.read_bytes()
    image = open_image(path)
    assert image.attributes["kind"] == "answer"
    reach = range(image.end_at, image.end_at + 8)  # of which blocks are a check
    rng = np.random.default_rng(0)
    for at in rng.choice(len(whole), 150, replace=False):
        changed = bytearray(whole)
        changed[at] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        if at not in reach:
            with pytest.raises((DamagedFileError, FileFormatError)):
                open_image(path)


def test_of_two_that_begin_a_file_one_comes_first(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    write_image(path, {}, packed({"header": "one"}), {"kind": "run"}, anew=True)
    with pytest.raises(FileExistsError):
        write_image(path, {}, packed({"header": "other"}), {"kind": "run"}, anew=True)
    assert unpacked(open_image(path).packed)["header"] == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]
