"""Map files of ROS: a YAML file with the numbers, beside an image whose pixels are occupancies.

Reads what ``map_server`` reads and writes what it reads. It needs Pillow and PyYAML, which the
extra ``robotics`` brings and which are loaded when a file is read or written. Maps turned against
the world are refused, since grids are not turned, and so are maps without a free cell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import FileFormatError, ParameterError, UnsupportedError, missing_extra
from bayesmc.robotics.grid import OccupancyGrid, as_grid

_MODES = ("trinary", "scale", "raw")
_FREE, _UNKNOWN, _OCCUPIED = 254, 205, 0  # grey of trinary maps, as map_saver writes them
_RAW_UNKNOWN = 255
_MISSING = object()


def read_map(path: Any, *, threshold: float = 0.5) -> OccupancyGrid:
    """The grid in a ROS map file.

    Parameters
    ----------
    path : path-like
        Of the YAML file, with ``image`` (relative to it), ``resolution`` (m per pixel), ``origin``
        (x, y, yaw of the image's lower left corner: m, m, rad), and, where they differ from the
        default, ``negate`` (0), ``occupied_thresh`` (0.65), ``free_thresh`` (0.196) and ``mode``
        (trinary).
    threshold : float
        Of the grid: see ``OccupancyGrid``.

    Returns
    -------
    OccupancyGrid

    Raises
    ------
    FileFormatError
        The YAML file or the image does not read, a value is missing or out of range (the message
        names file and key), or no cell is free, so that a robot could be nowhere.
    UnsupportedError
        The map is turned against the world (a yaw that is not 0); the message says how to work in
        its own frame.
    MissingExtraError
        Pillow or PyYAML is not installed.
    FileNotFoundError
        There is no YAML file of this name.

    Notes
    -----
    With darkness ``p = (255 - grey) / 255`` (``grey / 255`` where ``negate``; colours are averaged):

    - ``trinary``: 1 above ``occupied_thresh``, 0 below ``free_thresh``, unknown in between;
    - ``scale``: 1 and 0 likewise, in between linear from one to the other; unknown where fully
      transparent;
    - ``raw``: the pixel is a percentage; above 100 unknown.

    References
    ----------
    ROS wiki, package map_server, "Map format" and "Value Interpretation".

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from bayesmc.robotics.grid import OccupancyGrid
    >>> from bayesmc.robotics.mapfile import read_map, write_map
    >>> grid = OccupancyGrid([[0.0, 1.0, -1.0], [0.0, 0.0, 1.0]], 0.05, origin=(-1.0, 2.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     again = read_map(write_map(grid, Path(folder) / "room.yaml"))
    >>> again, again.occupancy.tolist()
    (OccupancyGrid(2 x 3 cells of 0.05 m, origin=(-1.0, 2.0)), [[0.0, 1.0, nan], [0.0, 0.0, 1.0]])
    """
    path = Path(path)
    keys = _Keys.of(path)
    if keys.yaw:
        turned = f"[{keys.x:g}, {keys.y:g}, {keys.yaw:g}]"
        raise UnsupportedError(
            f"read_map: {path}: key 'origin': the map is turned by {keys.yaw:g} rad against the world, "
            "and grids are not turned; set 'origin' to [0, 0, 0] and work in the map's own frame, where "
            f"robotics.between({turned}, pose) takes poses of the world and robotics.compose({turned}, "
            "pose) takes them back"
        )
    grey, alpha = _read_image(keys.image, path)
    occupancy = _occupancy(grey, alpha, keys)
    # rows run from the top down, columns along x
    grid = OccupancyGrid(occupancy[::-1].T, keys.resolution, (keys.x, keys.y), threshold)
    if not grid.free().any():
        raise FileFormatError(
            f"no cell is free: of {grey.size} pixels of {keys.image.name} {int(grid.occupied().sum())} "
            "are obstacles, the others unknown; is the image inverted (key 'negate', here "
            f"{int(keys.negate)}), or written for a mode other than {keys.mode!r}?",
            path,
        )
    return grid


def write_map(grid: OccupancyGrid, path: Any, *, mode: str = "trinary") -> Path:
    """Write a grid as a ROS map file: YAML, and a PNG image of the same name beside it.

    Parameters
    ----------
    grid : OccupancyGrid
    path : path-like
        Of the YAML file.
    mode : str
        ``"trinary"`` keeps obstacles, free and unknown cells, by the grid's threshold; ``"scale"``
        keeps probabilities to 1/510, ``"raw"`` to 1/200.

    Returns
    -------
    Path
        Of the YAML file.

    Raises
    ------
    ParameterError
        The mode is not known, ``path`` is that of an image, or its folder does not exist.
    TypeError
        ``grid`` is no OccupancyGrid.
    MissingExtraError
        Pillow or PyYAML is not installed.
    """
    grid = as_grid("write_map", grid)
    yaml, image = _yaml(), _pillow()
    path = Path(path)
    if mode not in _MODES:
        raise ParameterError(
            f"write_map: mode={mode!r}; give one of {', '.join(map(repr, _MODES))}"
        )
    if path.suffix not in (".yaml", ".yml"):
        raise ParameterError(
            f"write_map: path is that of the YAML file, and ends in .yaml; got {path}"
        )
    if not path.parent.is_dir():
        raise ParameterError(
            f"write_map: there is no folder {path.parent}; make it first: Path({str(path.parent)!r}).mkdir("
            "parents=True)"
        )
    pixels = _pixels(grid, mode)[:, ::-1].swapaxes(0, 1)
    picture = path.with_suffix(".png")
    image.fromarray(np.ascontiguousarray(pixels)).save(picture)
    keys = {
        "image": picture.name,
        "mode": mode,
        "resolution": float(grid.resolution),
        "origin": [*grid.origin, 0.0],
        "negate": 0,
        "occupied_thresh": 1.0 if mode == "scale" else 0.65,
        "free_thresh": 0.0 if mode == "scale" else 0.196,
    }
    path.write_text(yaml.safe_dump(keys, sort_keys=False), encoding="utf-8")
    return path


# ---- private ------------------------------------------------------------------------------------


class _Keys(NamedTuple):
    """What a YAML file says."""

    image: Path
    resolution: float
    x: float
    y: float
    yaw: float
    negate: bool
    occupied: float
    free: float
    mode: str

    @classmethod
    def of(cls, path: Path) -> _Keys:
        keys = _read_yaml(path)
        image = _text(keys, "image", path)
        resolution = _number(keys, "resolution", path)
        if not resolution > 0:
            raise FileFormatError(f"key 'resolution' must be positive; got {resolution:g}", path)
        x, y, yaw = _origin(keys, path)
        free = _number(keys, "free_thresh", path, 0.196)
        occupied = _number(keys, "occupied_thresh", path, 0.65)
        for name, value in (("free_thresh", free), ("occupied_thresh", occupied)):
            if not 0 <= value <= 1:
                raise FileFormatError(f"key {name!r} must be between 0 and 1; got {value:g}", path)
        if not free < occupied:
            raise FileFormatError(
                f"key 'free_thresh' must be below 'occupied_thresh'; got {free:g} and {occupied:g}",
                path,
            )
        negate = _number(keys, "negate", path, 0)
        if negate not in (0, 1):
            raise FileFormatError(f"key 'negate' must be 0 or 1; got {negate:g}", path)
        mode = _text(keys, "mode", path, "trinary")
        if mode not in _MODES:
            raise FileFormatError(
                f"key 'mode' must be one of {', '.join(map(repr, _MODES))}; got {mode!r}", path
            )
        place = path.parent / image
        return cls(place, resolution, x, y, yaw, bool(negate), occupied, free, mode)


def _read_yaml(path: Path) -> Mapping[str, Any]:
    yaml = _yaml()
    try:
        keys = yaml.safe_load(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise FileFormatError("is no text (give the YAML file, not the image)", path) from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        what = getattr(error, "problem", None) or "cannot be read"
        line = None if mark is None else mark.line + 1
        raise FileFormatError(f"is no YAML: {what}", path, line) from error
    if not isinstance(keys, Mapping):
        raise FileFormatError("has no keys; a map file has 'image', 'resolution', 'origin'", path)
    return keys


def _value(keys: Mapping[str, Any], name: str, path: Path, default: Any) -> Any:
    value = keys.get(name)
    if value is None:  # absent, or nothing after the colon
        if default is _MISSING:
            raise FileFormatError(f"key {name!r} is missing", path)
        return default
    return value


def _text(keys: Mapping[str, Any], name: str, path: Path, default: Any = _MISSING) -> str:
    value = _value(keys, name, path, default)
    if not isinstance(value, str) or not value:
        raise FileFormatError(f"key {name!r} must be text; got {value!r:.80}", path)
    return value


def _number(keys: Mapping[str, Any], name: str, path: Path, default: Any = _MISSING) -> float:
    return _as_number(_value(keys, name, path, default), name, path)


def _as_number(value: Any, name: str, path: Path) -> float:
    try:
        number = float(value)  # YAML 1.1 takes 5e-2 for text
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise FileFormatError(f"key {name!r} must be a finite number; got {value!r:.80}", path)
    return number


def _origin(keys: Mapping[str, Any], path: Path) -> tuple[float, float, float]:
    value = _value(keys, "origin", path, _MISSING)
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise FileFormatError(f"key 'origin' must be [x, y, yaw]; got {value!r:.80}", path)
    numbers = [_as_number(part, "origin", path) for part in value]
    x, y, yaw = numbers if len(numbers) == 3 else [*numbers, 0.0]
    return x, y, yaw


def _read_image(place: Path, path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Grey values 0..255 (colours averaged) and opacities of an image, shape (rows, columns)."""
    image = _pillow()
    if not place.is_file():
        raise FileFormatError(f"key 'image': there is no file {place}", path)
    try:
        with image.open(place) as picture:
            picture.load()
            pixels, mode = _as_pixels(picture)
    except (OSError, SyntaxError, ValueError, EOFError, image.DecompressionBombError) as error:
        raise FileFormatError(f"key 'image': {place} does not read: {error}", path) from error
    if pixels is None:
        raise FileFormatError(
            f"key 'image': {place} has pixels of the kind {mode!r}; save it as 8-bit grey or colour",
            path,
        )
    if not pixels.size:
        raise FileFormatError(f"key 'image': {place} has no pixels", path)
    if pixels.ndim == 2:
        return pixels, None
    if pixels.shape[2] in (2, 4):
        return pixels[..., :-1].mean(axis=-1), pixels[..., -1]
    return pixels.mean(axis=-1), None


def _as_pixels(picture: Any) -> tuple[np.ndarray | None, str]:
    mode = picture.mode
    if mode == "P":
        picture = picture.convert("RGBA" if "transparency" in picture.info else "RGB")
    elif mode == "1":
        picture = picture.convert("L")
    elif mode.startswith("I;16"):
        return np.asarray(picture, dtype=float) / 257.0, mode
    elif mode not in ("L", "LA", "RGB", "RGBA"):
        return None, mode
    return np.asarray(picture, dtype=float), mode


def _occupancy(grey: np.ndarray, alpha: np.ndarray | None, keys: _Keys) -> np.ndarray:
    """Occupancies in the image's layout, NaN where unknown."""
    if keys.mode == "raw":
        percent = np.rint(grey)
        return np.where(percent <= 100, percent / 100, np.nan)
    dark = grey / 255 if keys.negate else (255 - grey) / 255
    between: Any = np.nan
    if keys.mode == "scale":
        between = (dark - keys.free) / (keys.occupied - keys.free)
    value = np.where(dark > keys.occupied, 1.0, np.where(dark < keys.free, 0.0, between))
    if keys.mode == "scale" and alpha is not None:
        value = np.where(alpha == 0, np.nan, value)
    return value


def _pixels(grid: OccupancyGrid, mode: str) -> np.ndarray:
    """Pixels [ix, iy] (with an axis for grey and opacity in mode scale)."""
    unknown = np.isnan(grid.occupancy)
    value = np.where(unknown, 0.0, grid.occupancy)
    if mode == "trinary":
        grey = np.where(unknown, _UNKNOWN, np.where(grid.occupied(), _OCCUPIED, _FREE))
        return grey.astype(np.uint8)
    if mode == "raw":
        return np.where(unknown, _RAW_UNKNOWN, np.rint(100 * value)).astype(np.uint8)
    opaque = np.where(unknown, 0, 255)
    return np.stack([np.rint(255 * (1 - value)), opaque], axis=-1).astype(np.uint8)


def _yaml() -> Any:
    try:
        import yaml
    except ImportError:
        raise missing_extra("PyYAML", "robotics") from None
    return yaml


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError:
        raise missing_extra("Pillow", "robotics") from None
    return Image
