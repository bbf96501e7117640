"""Writes one message of every topic, as version 2 puts it on the wire: ``python tests/bus/samples/write_samples.py``.

Files that exist are not overwritten; a new version gets new files.
"""

from pathlib import Path

from safedpa.bus import (
    ActionMessage,
    AskedMessage,
    FindingMessage,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    NominalMessage,
    RosterEntry,
    RosterMessage,
    ScanMessage,
    SetupMessage,
    StateMessage,
    SurroundingsMessage,
    TakeoverMessage,
    VerdictMessage,
    encode,
)

VERSION = 2

_STAMP = {"version": VERSION, "epoch": 8731, "tick": 412, "robot_time": 20.6, "publish_time": 1795000000.25}

SAMPLES: dict[str, Message] = {
    "state": StateMessage(
        **_STAMP,
        values=(0.5, -1.25, 0.75, 1.5),
        applied=(1.4, -0.1),
        applied_by="filter",
        period=0.05,
        lockstep=True,
        goal=(2.0, 2.5),
        obstacles=((1.0, 0.0, 0.3), (-1.0, 2.0, 0.25)),
        field=(-4.0, 4.0, -4.0, 4.0),
        footprint=(0.8, 0.4, 0.12),
        load_pose=(0.1, -1.3, 0.7, 0.3, 0.2),
        goals_reached=3,
        collisions=1,
    ),
    "roster": RosterMessage(
        **_STAMP,
        source="5f2c",
        entries=(
            RosterEntry(kind="robot", name="r1", silent_for=0.05),
            RosterEntry(kind="service", name="policy", silent_for=9.5, restarts=2, cause="killed by signal 9"),
        ),
    ),
    "scan": ScanMessage(
        **_STAMP,
        source="laser",
        mount=(0.12, 0.0, 0.0),
        first_angle=-1.5,
        angle_step=1.5,
        ranges=(2.25, -1.0, 12.0),
        nearest=0.05,
        farthest=12.0,
        number=206,
    ),
    "surroundings": SurroundingsMessage(
        **_STAMP,
        points=((1.0, 0.0, 0.05), (-1.0, 2.0, 0.05)),
        movers=((0.5, 1.5, 0.1, 1.2, -0.3, 1.5),),
        hidden=((2.5, 1.0, 0.25, 1.5),),
        ages=(0.1,),
        problems=("the source laser was silent for 0.6 s, wanted 0.5 s at most",),
    ),
    "latent": LatentMessage(**_STAMP, model="0123456789ab", values=(0.4,), deviations=(0.05,)),
    "nominal": NominalMessage(**_STAMP, values=(1.6, 0.2), controller="goal_seeker:seek"),
    "action": ActionMessage(**_STAMP, values=(0.9, 0.3)),
    "verdict": VerdictMessage(
        **_STAMP,
        status="corrected",
        sentence="the nominal action was changed to keep the distance to obstacle 0",
        action=(0.9, 0.3),
        nominal=(1.6, 0.2),
        slack=0.01,
        active=("obstacle_0", "field"),
        h_now=0.4,
        h_next=0.35,
        margin=0.02,
        solver="PIQP_SOLVED",
        microseconds=42.5,
        predicted=((0.55, -1.2, 0.76, 1.45), (0.6, -1.15, 0.77, 1.4)),
    ),
    "health": HealthMessage(
        **_STAMP,
        service="policy",
        pid=4711,
        state="running",
        detail="the latent is 2 ticks old",
        steps=412,
        stale=2,
        refused=1,
        step_microseconds=31.5,
    ),
    "finding": FindingMessage(
        **_STAMP,
        model="0123456789ab",
        stage="candidates",
        sentence="towed_load explains the error since t = 14.2 s",
        number=2,
        error=0.31,
        band=0.12,
        evidence=9.5,
        threshold=9.2,
        coverage=0.87,
        where="speed 1.5 to 2 m/s",
        report='{"format": 1}',
    ),
    "model": ModelMessage(
        **_STAMP,
        step="offer",
        change=3,
        fingerprint="ba9876543210",
        replaces="0123456789ab",
        document="format = 1",
        margin='{"coverage": 0.99}',
        from_tick=417,
        who="engineer at the workbench",
        why="accept towed_load",
        data="r1 ticks 100 to 400",
    ),
    "takeover": TakeoverMessage(
        **_STAMP,
        service="policy",
        change=3,
        fingerprint="ba9876543210",
        state="refused",
        reason="the fingerprint differs",
    ),
    "asked": AskedMessage(
        **_STAMP,
        do="accept",
        ok=False,
        sentence="refused: change 3 is under way",
        effect="towed_load",
        model="0123456789ab",
        finding=2,
        who="engineer at the workbench",
        change=3,
    ),
    "setup": SetupMessage(
        **_STAMP,
        service="safety_filter",
        instance="0f3a",
        pid=4711,
        software='{"safedpa": "0.1.0"}',
        options='{"model": "car"}',
        fingerprint="0123456789ab",
        document="format = 1",
        settings="format = 2",
        margin='{"coverage": 0.99}',
        controller="",
    ),
}


def main() -> None:
    """Writes the files of this version next to this script."""
    for name, message in SAMPLES.items():
        path = Path(__file__).with_name(f"{name}.v{VERSION}.msgpack")
        if not path.exists():
            path.write_bytes(encode(message))


if __name__ == "__main__":
    main()
