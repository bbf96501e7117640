"""The paper's point robot among hazards: methods, learning behind the filter, relinearised networks, hidden effects.

``experiment`` compares the methods. Read it first; then ``learning``, ``relinearised``, ``heat_map``, ``story``.
"""

from __future__ import annotations

from pathlib import Path

from safedpa_lab.experiments.record import (
    FOLDER_OUT,
    Experiment,
    Parameter,
    integer,
    number,
    path,
    repeated,
    switch,
    text,
)

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="point",
        help="""SafeDPA and its baselines on the point robot among eight hazards.

    Every method gets the same layouts, forces and goals. Each filter has its own calibrated margin; in a second table
    all have SafeDPA's. Weights are searched in both folders, then among the shipped ones. Calibration, tuning of RMA-P
    and evaluation use different seeds.""",
        run=f"{__name__}.experiment:run",
        parameters=(
            path("--models", "folder of the learned models", default=Path("learned/point"), show_default=True),
            path("--baselines", None, default=Path("learned/point_baselines"), show_default=True),
            text("--methods", text="comma-separated; default: all", metavar="NAME,NAME,..."),
            integer("--directions", 24, "force directions, evenly spaced"),
            integer("--episodes", 20, "per method and direction"),
            integer("--steps", 1000, "per episode"),
            number("--force", 0.008, "force [N]"),
            integer("--drives", 400, "calibration drives per round"),
            integer("--seed", 0, "evaluation seed"),
            integer("--processes", 2),
            path("--record", "keep drives in this file and continue with it", metavar="FILE"),
            switch("--quick", "8 directions x 4 episodes of 500 steps"),
            FOLDER_OUT,
        ),
        report=f"{__name__}.report:markdown_of",
        figures=f"{__name__}.figures:write_figures",
        document=f"{__name__}.report:without_paths",
        extras=("train",),
        small=("--quick", "--methods", "unfiltered"),
    ),
    Experiment(
        name="point-heat-map",
        help="""The point robot near hazards in a wind: the change of h over turn and thrust, predicted by each model.

    Compares SafeDPA, Mix and each Fix with the simulator: correlation, and how often the sign of the change agrees.""",
        run=f"{__name__}.heat_map:run",
        parameters=(
            number("--direction", 135.0, "direction of the force [degrees]"),
            number("--force", 0.008, "force [N]"),
            integer("--moments", 60, "moments near hazards, drawn from drives"),
            integer("--points", 21, "grid points along thrust and turn"),
            integer("--seed", 0),
            path("--models", "folder of models; default: the shipped ones", "folder", default=Path()),
            FOLDER_OUT,
        ),
        report=f"{__name__}.heat_map:heat_map_markdown",
        figures=f"{__name__}.heat_map:write_figure",
        extras=("train",),
        small=("--moments", "2"),
    ),
    Experiment(
        name="point-learning",
        help="""A policy of the point robot continues to learn by PPO in winds, with SafeDPA's filter and without it.

    Starts: shipped is the PPO-Lagrangian with lidar and z as inputs; nothing is a new network with the inputs of
    SafeDPA's policy; careless is a PPO with the same inputs. Every learning step is counted, and the policies are
    evaluated before and after. With --record, an interrupted run continues after the last complete training.""",
        run=f"{__name__}.learning:run",
        parameters=(
            text("--starts", "shipped,nothing", "also: careless", metavar="NAME,NAME"),
            integer("--steps", 250000, "training steps of all robots together"),
            text("--seeds", "0,1,2", "training seeds", metavar="N,N,..."),
            integer("--robots", 64, "parallel robots per policy"),
            integer("--episodes", 1, "evaluation episodes per wind, of 24 winds"),
            number("--force", 0.008, "force of the wind [N]"),
            number("--margin", text="of the filter; default: that of 'experiment point'", metavar="M"),
            integer("--seed", 2500, "seed of layouts, goals and winds"),
            integer("--processes", 1),
            path("--record", "keep trainings in this file and continue with it", metavar="FILE"),
            switch("--quick", "4096 steps, 16 robots, one training seed"),
            FOLDER_OUT,
        ),
        report=f"{__name__}.learning:learning_markdown",
        figures=f"{__name__}.learning:write_figure",
        extras=("train",),
        small=("--quick", "--starts", "shipped"),
    ),
    Experiment(
        name="point-relinearised",
        help="""The point robot behind filters whose networks are not affine in the action, and behind affine ones.

    Free networks H(x, z, a) are relinearised by their own gradient about the nominal action, or about the filter's own
    action; with the clean thrust, and with the benchmark's, which saturates. Every filter gets z = mu(e) of the true
    wind.""",
        run=f"{__name__}.relinearised:run",
        parameters=(
            integer("--directions", 24, "force directions, evenly spaced"),
            integer("--episodes", 2, "per direction"),
            integer("--steps", 1000, "per episode"),
            integer("--drives", 100, "calibration drives"),
            integer("--drive-steps", 200, "steps per calibration drive"),
            integer("--seed", 2400, "offset into the evaluation and calibration seeds"),
            switch("--quick", "two episodes of 40 steps each: only shows that it runs"),
            Parameter(
                "--car",
                "car_pairs",
                type=int,
                help="also train both forms of the car's networks on this many pairs",
                positive=True,
            ),
            switch("--train", "first train the networks again, into --models: ten minutes"),
            path("--models", "folder; default: the shipped ones", default=Path()),
            integer("--processes", 1),
            path("--record", "keep each row in this file and continue with it"),
            FOLDER_OUT,
        ),
        report=f"{__name__}.relinearised:relinearised_markdown",
        extras=("train",),
        small=("--quick", "--drives", "99", "--car", "4096"),
        stem="relinearised",
    ),
    Experiment(
        name="point-story",
        help="""A point robot with an external force and drag that the model does not have.

    Logs are recorded and diagnosed, and the effects found are added. Then the filter keeps robots out of hazards with
    the shipped, the corrected and the true model.""",
        run=f"{__name__}.story:run",
        parameters=(
            repeated("--hidden", "hidden", "only this one: 'force and drag'"),
            integer("--robots", 128, "robots, each in its own layout", positive=True),
            number("--seconds", 10.0, "per episode", positive=True),
            integer("--seed", 0),
            FOLDER_OUT,
        ),
        report=f"{__name__}.story:point_story_markdown",
        extras=("diagnosis",),
        small=("--robots", "2", "--seconds", "1"),
    ),
)
