"""ROS map files: what pixels mean, what is written reads back, and what is wrong is said by file and key."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from bayesmc.errors import (
    FileFormatError,
    MissingExtraError,
    ParameterError,
    UnsupportedError,
)
from bayesmc.robotics.grid import OccupancyGrid
from bayesmc.robotics.mapfile import read_map, write_map
from bayesmc.robotics.poses import between, compose

yaml = pytest.importorskip("yaml", reason="PyYAML (extra robotics) is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow (extra robotics) is not installed")

NAN = float("nan")
KEYS = {"image": "map.png", "resolution": 0.05, "origin": [-1.0, 2.0, 0.0]}


def folder_with(folder: Path, pixels: object, **keys: object) -> Path:
    """A map of ``pixels`` (rows from the top down) with these keys; None leaves one out."""
    if pixels is not None:
        Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(folder / "map.png")
    named = {k: v for k, v in {**KEYS, **keys}.items() if v is not None}
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(named), encoding="utf-8")
    return path


def test_rows_run_down_and_columns_along_x(tmp_path: Path):
    grid = read_map(folder_with(tmp_path, [[0, 254, 254], [254, 254, 205]]))
    assert grid.shape == (3, 2)
    np.testing.assert_array_equal(grid.occupancy, [[0, 1], [0, 0], [NAN, 0]])
    assert grid.resolution == 0.05 and grid.origin == (-1.0, 2.0)
    assert grid.at([-0.99, 2.09]) == 1.0  # the top left pixel: least x, greatest y


SHADES = np.array([[0, 88, 90, 127, 204, 206, 255]])


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        # darkness 1, .655, .647, .502, .2, .192, 0
        ({}, [1, 1, NAN, NAN, NAN, 0, 0]),
        ({"negate": 1}, [0, NAN, NAN, NAN, 1, 1, 1]),
        ({"occupied_thresh": 0.5, "free_thresh": 0.2}, [1, 1, 1, 1, NAN, 0, 0]),
        (
            {"mode": "scale"},
            [1, 1, *((np.array([165, 128, 51]) / 255 - 0.196) / 0.454), 0, 0],
        ),
        ({"mode": "raw"}, [0, 0.88, 0.9, NAN, NAN, NAN, NAN]),
    ],
)
def test_shades(tmp_path: Path, keys: dict, expected: list):
    grid = read_map(folder_with(tmp_path, SHADES, **keys))
    np.testing.assert_allclose(grid.occupancy[:, 0], expected)


def test_colours_and_transparency(tmp_path: Path):
    colours = np.zeros((1, 3, 4), dtype=np.uint8)
    colours[0, :, 3] = [255, 255, 0]
    colours[0, 0, :3] = [255, 255, 252]  # their mean is light
    np.testing.assert_array_equal(
        read_map(folder_with(tmp_path, colours)).occupancy[:, 0], [0, 1, 1]
    )
    scaled = read_map(folder_with(tmp_path, colours, mode="scale"))
    np.testing.assert_array_equal(scaled.occupancy[:, 0], [0, 1, NAN])
    np.testing.assert_array_equal(
        read_map(folder_with(tmp_path, colours[..., :3])).occupancy[:, 0], [0, 1, 1]
    )


@pytest.mark.parametrize("kind", ["map.pgm", "map.bmp", "deep.png", "palette.png", "bits.png"])
def test_kinds_of_image(tmp_path: Path, kind: str):
    pixels = np.array([[0, 255], [255, 255]], dtype=np.uint8)
    picture = Image.fromarray(pixels)
    if kind == "deep.png":
        picture = Image.fromarray(pixels.astype(np.uint16) * 257)
    elif kind == "palette.png":
        picture = picture.convert("P")
    elif kind == "bits.png":
        picture = picture.convert("1")
    picture.save(tmp_path / kind)
    grid = read_map(folder_with(tmp_path, None, image=kind))
    np.testing.assert_array_equal(grid.occupancy, [[0, 1], [0, 0]])


def test_pgm_as_map_saver_writes_it(tmp_path: Path):
    header = b"P5\n# CREATOR: map_saver.cpp 0.050 m/pix\n3 1\n255\n"
    (tmp_path / "map.pgm").write_bytes(header + bytes([0, 205, 254]))
    grid = read_map(folder_with(tmp_path, None, image="map.pgm"))
    np.testing.assert_array_equal(grid.occupancy, [[1], [NAN], [0]])


# ---- there and back -----------------------------------------------------------------------------


def some_grid() -> OccupancyGrid:
    rng = np.random.default_rng(0)
    occupancy = np.where(rng.random((17, 9)) < 0.2, NAN, rng.random((17, 9)))
    return OccupancyGrid(occupancy, 0.025, origin=(-3.125, 7.0), threshold=0.4)


@pytest.mark.parametrize(("mode", "error"), [("raw", 1 / 200), ("scale", 1 / 510)])
def test_probabilities_there_and_back(tmp_path: Path, mode: str, error: float):
    grid = some_grid()
    again = read_map(write_map(grid, tmp_path / "m.yaml", mode=mode), threshold=0.4)
    np.testing.assert_allclose(again.occupancy, grid.occupancy, atol=error + 1e-12)
    assert np.nanmax(np.abs(again.occupancy - grid.occupancy)) > error / 2  # it is rounded
    assert (again.resolution, again.origin, again.threshold) == (0.025, (-3.125, 7.0), 0.4)


def test_kinds_of_cell_there_and_back(tmp_path: Path):
    grid = some_grid()
    path = write_map(grid, str(tmp_path / "m.yaml"))
    again = read_map(str(path))
    np.testing.assert_array_equal(again.occupied(), grid.occupied())
    np.testing.assert_array_equal(again.free(), grid.free())
    once_more = read_map(write_map(again, tmp_path / "n.yml"))
    np.testing.assert_array_equal(once_more.occupancy, again.occupancy)


def test_writing_refuses(tmp_path: Path):
    with pytest.raises(ParameterError, match="mode='grey'; give one of 'trinary'"):
        write_map(some_grid(), tmp_path / "m.yaml", mode="grey")
    with pytest.raises(ParameterError, match="ends in .yaml"):
        write_map(some_grid(), tmp_path / "m.png")
    with pytest.raises(ParameterError, match="there is no folder .*nowhere; make it first"):
        write_map(some_grid(), tmp_path / "nowhere" / "m.yaml")
    assert list(tmp_path.iterdir()) == []


# ---- what is wrong ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"image": None}, "key 'image' is missing"),
        ({"image": "none.png"}, "key 'image': there is no file .*none.png"),
        ({"image": 7}, "key 'image' must be text; got 7"),
        ({"resolution": None}, "key 'resolution' is missing"),
        ({"resolution": "fine"}, "key 'resolution' must be a finite number; got 'fine'"),
        ({"resolution": NAN}, "key 'resolution' must be a finite number"),
        ({"resolution": 0}, "key 'resolution' must be positive; got 0"),
        ({"resolution": -0.05}, "key 'resolution' must be positive; got -0.05"),
        ({"origin": None}, "key 'origin' is missing"),
        ({"origin": 3.0}, r"key 'origin' must be \[x, y, yaw\]; got 3.0"),
        ({"origin": [1.0]}, r"key 'origin' must be \[x, y, yaw\]"),
        ({"origin": [1.0, "a", 0.0]}, "key 'origin' must be a finite number; got 'a'"),
        ({"negate": 2}, "key 'negate' must be 0 or 1"),
        ({"free_thresh": 1.5}, "key 'free_thresh' must be between 0 and 1"),
        (
            {"free_thresh": 0.65, "occupied_thresh": 0.196},
            "'free_thresh' must be below .* 0.65 and 0.196",
        ),
        ({"free_thresh": 0.7}, "'free_thresh' must be below 'occupied_thresh'"),
        ({"mode": "sepia"}, "key 'mode' must be one of .*; got 'sepia'"),
    ],
)
def test_bad_keys(tmp_path: Path, keys: dict, message: str):
    path = folder_with(tmp_path, [[254]], **keys)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_map(path)
    assert str(path) in str(caught.value) and caught.value.path == path


def test_numbers_that_yaml_takes_for_text(tmp_path: Path):
    path = folder_with(tmp_path, [[254]], resolution="5e-2", origin=[0, "1e1", 0])
    assert read_map(path).resolution == 0.05


def test_turned_maps_are_refused_and_the_way_out_is_right(tmp_path: Path):
    turn, pixels = np.pi / 2, [[254, 254, 254], [254, 254, 0]]
    with pytest.raises(
        UnsupportedError, match="map.yaml: key 'origin': .* turned by 0.5"
    ) as caught:
        read_map(folder_with(tmp_path, pixels, origin=[1, 2, 0.5]))
    assert "robotics.between([1, 2, 0.5], pose)" in str(caught.value)
    # what it advises: the third pixel of the lowest row lies 2.5 cells from the corner, along +y here
    grid = read_map(folder_with(tmp_path, pixels, origin=[0, 0, 0]))
    there = [1.0 - 0.5 * 0.05, 2.0 + 2.5 * 0.05, 0.0]
    assert grid.at(between([1.0, 2.0, turn], there)) == 1.0
    np.testing.assert_allclose(
        compose([1.0, 2.0, turn], between([1.0, 2.0, turn], there)), there, atol=1e-12
    )


@pytest.mark.parametrize(
    ("pixels", "keys", "message"),
    [
        ([[0, 0], [0, 0]], {}, "of 4 pixels of map.png 4 are obstacles"),
        ([[205, 205, 205]], {}, "of 3 pixels of map.png 0 are obstacles, the others unknown"),
        ([[0, 205, 50]], {}, "of 3 pixels of map.png 2 are obstacles"),
        ([[254, 254]], {"negate": 1}, "is the image inverted .key 'negate', here 1"),
        ([[254, 254]], {"mode": "raw"}, "0 are obstacles, .* a mode other than 'raw'"),
    ],
)
def test_maps_without_a_free_cell(tmp_path: Path, pixels: list, keys: dict, message: str):
    path = folder_with(tmp_path, pixels, **keys)
    with pytest.raises(FileFormatError, match=f"no cell is free: .*{message}") as caught:
        read_map(path)
    assert str(caught.value).startswith(str(path)) and caught.value.path == path
    one_free = np.array(pixels)
    one_free[0, 0] = 0 if keys else 254
    assert read_map(folder_with(tmp_path, one_free, **keys)).free().sum() == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"image: [\nresolution", "map.yaml:2: is no YAML"),
        (b"", "has no keys"),
        (b"- 1\n- 2\n", "has no keys"),
        (b"\x89PNG\r\n\x1a\n\xff\xfe", "is no text"),
    ],
)
def test_files_that_are_no_yaml(tmp_path: Path, content: bytes, message: str):
    path = tmp_path / "map.yaml"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_map(path)
    with pytest.raises(FileNotFoundError):
        read_map(tmp_path / "other.yaml")


@pytest.mark.parametrize(
    "content",
    [b"", b"no image", b"P5\n4 4\n255\n\x00\x00", b"P5\n0 0\n255\n", b"P5\n-3 x\n255\n"],
)
def test_images_that_do_not_read(tmp_path: Path, content: bytes):
    (tmp_path / "map.png").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"map.yaml: key 'image': .*map.png"):
        read_map(folder_with(tmp_path, None))


def test_pixels_of_other_kinds(tmp_path: Path):
    Image.fromarray(np.zeros((2, 2), dtype=np.float32)).save(tmp_path / "map.tiff")
    with pytest.raises(FileFormatError, match="pixels of the kind 'F'; save it as 8-bit"):
        read_map(folder_with(tmp_path, None, image="map.tiff"))


@pytest.mark.parametrize(("module", "package"), [("yaml", "PyYAML"), ("PIL", "Pillow")])
def test_missing_extras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, package: str):
    path = folder_with(tmp_path, [[0]])
    monkeypatch.setitem(sys.modules, module, None)
    for call in (lambda: read_map(path), lambda: write_map(some_grid(), tmp_path / "m.yaml")):
        with pytest.raises(MissingExtraError, match=rf"{package}.*bayesmc\[robotics\]"):
            call()


def test_what_is_no_grid_is_not_written(tmp_path):
    with pytest.raises(
        TypeError, match=r"write_map: give an OccupancyGrid.*array of shape \(3, 3\)"
    ):
        write_map(np.zeros((3, 3)), tmp_path / "room.yaml")
    assert not list(tmp_path.iterdir())
