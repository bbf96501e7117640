"""Draws the glossary's pictures into docs/pictures/glossary: ``python docs/draw_glossary.py [FOLDER]``.

All of them show one example, the mass before a wall of the README: position x0 [m], speed x1 [m/s], acceleration as the
action, 20 ticks a second. What is drawn is what the filter decides, nothing is drawn by hand; the latent's picture is
the shipped car's encoder. The same version draws the same bytes again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from safedpa.dynamics import LearnedBase, load_model
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Verdict

FOLDER = Path(__file__).parent / "pictures" / "glossary"
COLOURS = {"passed": "#009E73", "corrected": "#0072B2", "relaxed": "#E69F00", "violated": "#D55E00"}
"""Of Okabe and Ito."""
GREY, BLUE, ORANGE, RED = "#777777", "#0072B2", "#E69F00", "#D55E00"
TICKS = 60
FORWARD = 1.0
"""m/s2: the policy requests full speed at the wall."""


def moved(state: Any) -> Any:
    """f(x): (position, speed) after 0.05 s without acceleration."""
    return np.array([state[0] + 0.05 * state[1], state[1]])


def room(state: Any) -> float:
    """h(x) [m]: room to the wall at 1 m, less the distance to stop."""
    return float(1.0 - state[0] - max(state[1], 0.0) ** 2 / 1.6 - 0.1 * max(state[1], 0.0))


def made(eta: float = 0.1, epsilon: float = 0.002) -> SafetyFilter:
    """The filter of the README."""
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=eta, epsilon=epsilon)
    push = np.array([[0.00125], [0.05]])
    return SafetyFilter(lambda state: (moved(state), push), [FunctionBarrier(room)], settings)


def driven(eta: float = 0.1, epsilon: float = 0.002, error: float = 0.0) -> tuple[Any, list[Verdict]]:
    """States (ticks, 2) and verdicts of a drive at the wall; ``error`` [m/s2] pushes and no model knows."""
    safe, state, states, verdicts = made(eta, epsilon), np.array([0.0, 0.5]), [], []
    for _ in range(TICKS):
        verdict = safe.decide(state, nominal=[FORWARD])
        states.append(state)
        verdicts.append(verdict)
        state = moved(state) + np.array([0.00125, 0.05]) * (float(verdict.action[0]) + error)
    return np.array(states), verdicts


def draw_h(axes: Any) -> None:
    """h over the position, at three speeds."""
    positions = np.linspace(0.0, 1.2, 100)
    for speed, colour in ((0.0, BLUE), (0.5, ORANGE), (1.0, RED)):
        axes.plot(positions, [room((x, speed)) for x in positions], color=colour, label=f"{speed:g} m/s")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.legend(title="speed", fontsize=7, title_fontsize=7)
    axes.set(xlabel="position [m]; the wall is at 1 m", ylabel="h [m]")


def draw_barrier(axes: Any) -> None:
    """The safe set h >= 0 over position and speed, and a drive that stays in it."""
    x, v = np.meshgrid(np.linspace(0.0, 1.2, 120), np.linspace(0.0, 1.2, 120))
    heights = np.vectorize(lambda position, speed: room((position, speed)))(x, v)
    axes.contourf(x, v, heights, levels=[0.0, 10.0], colors=["#009E73"], alpha=0.25)
    axes.contour(x, v, heights, levels=[0.0], colors=["#009E73"])
    states, _ = driven()
    axes.plot(states[:, 0], states[:, 1], color=BLUE, marker=".", markersize=3)
    axes.text(0.08, 0.12, "h >= 0", color="#009E73")
    axes.set(xlabel="position [m]", ylabel="speed [m/s]")


def draw_eta(axes: Any) -> None:
    """How fast h may fall, by eta."""
    for eta, colour in ((0.05, BLUE), (0.1, ORANGE), (0.4, RED)):
        states, _ = driven(eta=eta)
        axes.plot(np.arange(TICKS) * 0.05, [room(state) for state in states], color=colour, label=f"{eta:g}")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.legend(title="eta", fontsize=7, title_fontsize=7)
    axes.set(xlabel="time [s]", ylabel="h [m]")


def draw_epsilon(axes: Any) -> None:
    """The same drive, pushed by something that the model does not know, with and without epsilon."""
    for epsilon, colour in ((0.0, RED), (0.005, ORANGE), (0.02, BLUE)):
        states, _ = driven(epsilon=epsilon, error=0.1)
        axes.plot(np.arange(TICKS) * 0.05, [room(state) for state in states], color=colour, label=f"{epsilon:g} m")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.legend(title="epsilon", fontsize=7, title_fontsize=7)
    axes.set(xlabel="time [s]", ylabel="h [m]", ylim=(-0.03, 0.25), xlim=(1.0, 3.0))


def draw_margin(axes: Any) -> None:
    """How much worse h turned out than predicted over many steps, and the quantile that is the margin."""
    random = np.random.default_rng(1)
    pushes = random.normal(0.0, 0.08, 4000)
    states = random.uniform((0.0, 0.0), (0.8, 1.0), (4000, 2))
    worse = [
        room(moved(state)) - room(moved(state) + np.array([0.00125, 0.05]) * push)
        for state, push in zip(states, pushes, strict=True)
    ]
    margin = float(np.quantile(worse, 0.99))
    axes.hist(np.array(worse) * 1000.0, bins=60, color=BLUE, alpha=0.6)
    axes.axvline(margin * 1000.0, color=RED)
    axes.text(margin * 1000.0, axes.get_ylim()[1] * 0.9, " margin: 99 % lie left", color=RED, fontsize=7, ha="left")
    axes.set(xlabel="h predicted less h measured [mm]", ylabel="steps", xlim=(-12.0, 24.0))


def draw_latent(axes: Any) -> None:
    """The shipped car's encoder: the latent's numbers over the mass of what is towed."""
    base = load_model("car_learned").base
    assert isinstance(base, LearnedBase)
    masses = np.linspace(0.0, 1.5, 30)
    low = [entry.low for entry in base.weights.description.environment]
    latents = np.array([base.networks.encode(np.array([mass, *low[1:]])) for mass in masses])
    for index in range(latents.shape[1]):
        axes.plot(masses, latents[:, index], label=f"z{index + 1}")
    axes.legend(fontsize=7)
    axes.set(xlabel="towed mass over the car's own", ylabel="latent")


def draw_verdict(axes: Any) -> None:
    """What was requested and what was done in a drive at the wall, coloured by the verdict."""
    _, verdicts = driven()
    times = np.arange(TICKS) * 0.05
    axes.plot(times, np.full(TICKS, FORWARD), color=GREY, linestyle="--", label="nominal")
    for status, colour in COLOURS.items():
        at = [index for index, verdict in enumerate(verdicts) if verdict.status.value == status]
        if at:
            actions = [float(verdicts[index].action[0]) for index in at]
            axes.plot(times[at], actions, ".", color=colour, label=status)
    axes.legend(fontsize=7)
    axes.set(xlabel="time [s]", ylabel="acceleration [m/s2]")


def draw_status(axes: Any) -> None:
    """The verdict's status in every state: full acceleration at the wall is requested."""
    safe, names = made(epsilon=0.02), list(COLOURS)
    positions, speeds = np.linspace(0.3, 1.1, 41), np.linspace(0.0, 1.2, 41)
    found = [
        [names.index(safe.decide(np.array([x, v]), nominal=[FORWARD]).status.value) for x in positions] for v in speeds
    ]
    colours = mpl.colors.ListedColormap(list(COLOURS.values()))
    box = (positions[0], positions[-1], speeds[0], speeds[-1])
    axes.imshow(np.array(found), cmap=colours, vmin=-0.5, vmax=3.5, origin="lower", extent=box, aspect="auto")
    for name, colour in COLOURS.items():
        axes.plot([], [], "s", color=colour, label=name)
    axes.legend(fontsize=7, loc="upper right")
    axes.set(xlabel="position [m]", ylabel="speed [m/s]")


PICTURES: dict[str, Callable[[Any], None]] = {
    "h": draw_h,
    "barrier": draw_barrier,
    "eta": draw_eta,
    "epsilon": draw_epsilon,
    "margin": draw_margin,
    "latent": draw_latent,
    "verdict": draw_verdict,
    "status": draw_status,
}


def draw(name: str, folder: Path) -> Path:
    """Draws one picture; returns its path."""
    with mpl.rc_context({"svg.hashsalt": "safedpa", "svg.fonttype": "none", "font.size": 8}):
        figure = Figure(figsize=(3.6, 2.4), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        PICTURES[name](axes)
        axes.spines[["top", "right"]].set_visible(False)
        path = folder / f"{name}.svg"
        figure.savefig(path, metadata={"Date": None})
    return path


if __name__ == "__main__":
    into = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    into.mkdir(parents=True, exist_ok=True)
    for picture in PICTURES:
        sys.stdout.write(f"{draw(picture, into)}\n")
