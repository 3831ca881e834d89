"""A talking head followed by Condensation: an outline, edges along its normals, and many hypotheses.

The outline is an ellipse that an affine map moves; a second-order process says how; each particle is weighed
by the edges of the frame along its normals, among clutter. The dynamics are learned from the first half
of the clip: a run with plain ones (speeds that die away) gives trajectories, and these are what is
learned from.

Carphone is a head before striped blinds. Where it is not at hand, a drawn silhouette takes its place.
The last picture is a drawn scene in which a second outline of the same shape is met: a Kalman filter
given the nearest edges goes off with it; particles hold both to be possible until one of them has left
the frame.

Isard and Blake (1998), CONDENSATION: conditional density propagation for visual tracking, IJCV 29; North and
Blake (1998), Learning dynamical models using expectation-maximisation, ICCV.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.vision import (
    Contour,
    ContourEdges,
    SecondOrder,
    ShapeSpace,
    as_frames,
    fit_dynamics,
)
from examples import picture, rendered
from examples.reference import folder
from examples.rendered import Scene

SEED, PARTICLES, MANY = 0, 1000, 4000
TRAINING, TRAJECTORIES = 60, 100  # frames, and paths that are learned from
NOISE, DAMPING = (
    1.0,
    0.5,
)  # px per frame squared of the place (a third of it in shape); of plain dynamics
DOUBT = 0.25  # tempering where it is met by another: the less, the longer several hypotheses live
AHEAD = 0.4  # the same where it is met by another
SUDDEN, AWAY = (
    0.05,
    3.0,
)  # probability in a frame of stopping short, and the speed in px with which it goes on


class Clip(NamedTuple):
    """Frames, the shapes an outline can take, and where its middle is in some frames."""

    name: str
    frames: np.ndarray
    space: ShapeSpace
    start: np.ndarray
    truth: dict[int, np.ndarray]


def carphone(data: Path) -> Clip:
    """The clip, with the ellipse of its first frame as the template."""
    frames = as_frames(np.load(data / "carphone_pristine.npz")["frames"])
    drawn = json.loads((data / "carphone_head_ellipses.json").read_text("utf-8"))
    one = drawn["0"]
    template = Contour.ellipse(
        (one["cx"], one["cy"]), (one["semi_x"], one["semi_y"]), np.deg2rad(one["angle_deg"])
    )
    truth = {int(k): np.array([e["cx"], e["cy"]]) for k, e in drawn.items()}
    return Clip("carphone", frames, ShapeSpace(template), np.zeros(6), truth)


def silhouette(kind: str = "bean", seed: int = 0, steps: int = 60) -> Clip:
    """A drawn outline: see ``rendered.silhouette``."""
    scene = rendered.silhouette(kind, steps, seed)
    truth = dict(enumerate(scene.space.center(scene.states)))
    return Clip(f"a drawn {kind}", scene.frames, scene.space, scene.states[0], truth)


def plain(size: int, noise: float = NOISE) -> SecondOrder:
    """Speeds that die away: where nothing has been learned."""
    return SecondOrder.steady(size, noise * np.array([1.0, 1.0] + [0.3] * (size - 2)), DAMPING)


def model(
    edges: ContourEdges, moves: Callable[[Any, Any], Any], start: np.ndarray, speed: Any = 0.0
) -> bmc.DynamicBayesNet:
    """An outline that moves, and frames that are weighed by it.

    ``moves(previous, before)`` is the density of the next state; exchange it, or ``edges.given``, at will.
    """
    dbn, size = bmc.DynamicBayesNet("condensation"), edges.space.size
    near = bmc.MvNormal(start, scale_diag=[1.5, 1.5] + [1.0] * (size - 2))

    @dbn.node(initial=near)
    def shape(shape_prev, before_prev):
        return moves(shape_prev, before_prev)

    @dbn.node(initial=lambda shape: shape - speed)
    def before(shape_prev):
        return shape_prev

    @dbn.node
    def frame(shape):
        return edges.given(shape)

    return dbn


def learned(clip: Clip, edges: ContourEdges, frames: int = TRAINING, rng: int = 1) -> SecondOrder:
    """Dynamics from trajectories of a first run over the training stretch."""
    dbn = model(edges, plain(clip.space.size).given, clip.start)
    paths = bmc.smooth(
        dbn, {"frame": clip.frames[:frames]}, engine=bmc.ParticleFilter(PARTICLES), rng=rng,
        trajectories=TRAJECTORIES,
    )  # fmt: skip
    return fit_dynamics(np.moveaxis(paths.particles("shape"), 0, 1))


def followed(
    clip: Clip,
    edges: ContourEdges,
    dynamics: SecondOrder,
    rng: int = SEED,
    particles: int = PARTICLES,
) -> np.ndarray:
    """Means of the states, (time, size)."""
    dbn = model(edges, dynamics.given, clip.start)
    found = bmc.filter(dbn, {"frame": clip.frames}, engine=bmc.ParticleFilter(particles), rng=rng)
    return found.mean("shape")


def errors(clip: Clip, states: np.ndarray) -> dict[int, float]:
    """Distance of the middle from the truth in px, by frame."""
    middles = clip.space.center(states)
    return {
        k: float(np.hypot(*(middles[k] - at))) for k, at in clip.truth.items() if k < len(states)
    }


# ---- the decoy ----------------------------------------------------------------------------------


def sudden(dynamics: SecondOrder) -> Callable[[Any, Any], Any]:
    """The same, but now and then it stops short and goes on in any direction, which is not Gaussian."""
    root = dynamics.root.copy()
    root[0, 0] = root[1, 1] = AWAY

    def moves(previous: Any, before: Any) -> Any:
        anew = bmc.MvNormal(previous, scale_tril=root)
        return bmc.Mixture([1 - SUDDEN, SUDDEN], [dynamics.given(previous, before), anew])

    return moves


def met(scene: Scene, rng: int = SEED, particles: int = MANY) -> Any:
    """Condensation in a scene with a decoy; the particles of all slices."""
    edges, speed = (
        ContourEdges(scene.space, scene.frames.shape[1:], tempering=DOUBT),
        scene.states[1] - scene.states[0],
    )
    dynamics = SecondOrder.steady(scene.space.size, [AHEAD, AHEAD, 0.1, 0.1])
    dbn = model(edges, sudden(dynamics), scene.states[0], speed)
    engine = bmc.ParticleFilter(particles)
    return bmc.filter(dbn, {"frame": scene.frames}, engine=engine, rng=rng, keep="particles")


def kalman(scene: Scene) -> np.ndarray:
    """The contour tracker of one hypothesis: nearest edges, and speeds that change; means of the states.

    Its noise is that of Condensation's transition, sudden turns included.
    """
    edges, size = ContourEdges(scene.space, scene.frames.shape[1:]), scene.space.size
    noise = np.sqrt([(1 - SUDDEN) * AHEAD**2 + SUDDEN * AWAY**2] * 2 + [0.01] * 2)
    dynamics = SecondOrder.steady(size, noise)
    dbn = bmc.DynamicBayesNet("contour", plates={"line": edges.lines})
    dbn.input("row", plates="line", event_shape=(size,))
    first = np.concatenate([scene.states[0], scene.states[0] - (scene.states[1] - scene.states[0])])
    ahead = np.block([[dynamics.last, dynamics.earlier], [np.eye(size), np.zeros((size, size))]])
    spread = np.concatenate([noise, np.full(size, 1e-3)])

    @dbn.node(
        initial=bmc.MvNormal(first, scale_diag=np.concatenate([[1.5, 1.5, 1.0, 1.0], [0.1] * 4]))
    )
    def both(both_prev):
        return bmc.MvNormal(np.matvec(ahead, both_prev), scale_diag=spread)

    @dbn.node(plates="line")
    def edge(both, row):
        return bmc.Normal(np.vecdot(row, both[..., :size]), edges.sigma)

    engine, mean, found = bmc.KalmanFilter(), first, []
    belief = engine.start(dbn)
    for k, frame in enumerate(scene.frames):
        rows, values = edges.nearest(frame, (ahead @ mean if k else mean)[:size])
        belief = engine.step(belief, {"edge": values}, inputs={"row": rows})
        mean = belief.mean("both")
        found.append(mean[:size])
    return np.array(found)


# ---- pictures -----------------------------------------------------------------------------------


def report(name: str, found: dict[int, float]) -> None:
    """Print how far off the middle is."""
    shown = list(found.items())[:: max(1, len(found) // 8)]
    print(
        f"  {name}: worst {max(found.values()):.1f} px; "
        + ", ".join(f"{k}: {e:.1f}" for k, e in shown)
    )


def draw(clip: Clip, states: np.ndarray) -> Any:
    """Frames with the outline, and the true middle as a cross."""
    shown = [k for k in clip.truth if k < len(states)]
    shown = shown[:: max(1, len(shown) // 8)][:8]
    names = [f"frame {k}" for k in shown]
    half = -(-len(names) // 2)
    grid = [names[:half], [*names[half:], *["."] * (2 * half - len(names))]]
    figure, panels = picture.axes(grid, (3.4 * half, 6))
    for k, name in zip(shown, names, strict=True):
        _outline(panels[name], clip.frames[k], clip.space, states[k], picture.OTHER)
        panels[name].plot(*clip.truth[k], "+", color=picture.DRAWS, ms=12, mew=2)
        panels[name].set_title(name)
    return figure


def draw_met(scene: Scene, found: Any, alone: np.ndarray, rng: int = SEED) -> Any:
    """Before, after, and once the other one has left: particles, and the Kalman filter's outline."""
    shown = (20, 34, 40, len(scene.frames) - 1)
    names = [f"frame {k}" for k in shown]
    figure, panels = picture.axes([names[:2], names[2:]], (10, 7.6))
    pick = np.random.default_rng(rng)
    for k, name in zip(shown, names, strict=True):
        ax = panels[name]
        _outline(ax, scene.frames[k], scene.space, alone[k], picture.OTHER)
        some = pick.choice(len(found.weights[k]), 40, p=found.weights[k])
        for state in found.particles("shape")[k][some]:
            _line(ax, scene.space, state, picture.DRAWS, 0.6)
        ax.plot(*scene.space.center(scene.states[k]), "+", color="white", ms=12, mew=2)
        ax.set_title(f"{name}: particles, and a Kalman filter (red)")
    return figure


def animate(clip: Clip, states: np.ndarray, folder: Path, name: str) -> None:
    """Write the clip with its outline as an animated picture."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure, ax = picture.pyplot().subplots(figsize=(4.4, 3.6), layout="constrained")
    image = ax.imshow(clip.frames[0], cmap="gray", vmin=0, vmax=255)
    (line,) = ax.plot([], [], color=picture.OTHER, lw=2)
    ax.set_axis_off()

    def show(k: int) -> Any:
        points = clip.space.points(states[k])
        image.set_data(clip.frames[k])
        line.set_data(*np.vstack([points, points[:1]]).T)
        return image, line

    folder.mkdir(parents=True, exist_ok=True)
    FuncAnimation(figure, show, frames=len(states)).save(
        folder / f"{name}.gif", PillowWriter(fps=12), dpi=70
    )
    picture.pyplot().close(figure)
    print(f"wrote {folder / name}.gif")


def main(arguments: Sequence[str] | None = None) -> None:
    """Follow the head, and meet a decoy."""
    options = picture.options(__doc__, arguments)
    data = folder("vision")
    if data is None:
        print("no folder 'vision' of the data (BAYESMC_DATA): a drawn outline instead of carphone")
    clip = silhouette() if data is None else carphone(data)
    training = TRAINING
    if options.fast:
        clip, training = clip._replace(frames=clip.frames[:20]), 12
    edges = ContourEdges(clip.space, clip.frames.shape[1:])
    print(f"{clip.name}: {len(clip.frames)} frames, {PARTICLES} particles, {edges.lines} normals")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bmc.errors.BayesmcWarning)
        plainly = followed(clip, edges, plain(clip.space.size))
        states = followed(clip, edges, learned(clip, edges, training))
    report("plain dynamics", errors(clip, plainly))
    report("learned dynamics", errors(clip, states))
    picture.save(draw(clip, states), options.out, "talking_head")
    if options.fast:
        return
    animate(clip, states, options.out, "talking_head")
    scene = rendered.with_decoy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bmc.errors.BayesmcWarning)
        found, alone = met(scene), kalman(scene)
    for name, means in (("Condensation", found.mean("shape")), ("Kalman filter", alone)):
        off = np.hypot(*(scene.space.center(means) - scene.space.center(scene.states)).T)
        print(f"  met by a decoy, {name}: {off[-5:].mean():.1f} px off in the last five frames")
    picture.save(draw_met(scene, found, alone), options.out, "talking_head_decoy")


# ---- private ------------------------------------------------------------------------------------


def _outline(ax: Any, frame: np.ndarray, space: ShapeSpace, state: np.ndarray, colour: str) -> None:
    ax.imshow(frame, cmap="gray", vmin=0, vmax=255)
    _line(ax, space, state, colour, 2.0)
    ax.set(xlim=(0, frame.shape[1]), ylim=(frame.shape[0], 0), xticks=[], yticks=[])


def _line(ax: Any, space: ShapeSpace, state: np.ndarray, colour: str, width: float) -> None:
    points = space.points(state)
    ax.plot(*np.vstack([points, points[:1]]).T, color=colour, lw=width)


if __name__ == "__main__":
    main()
