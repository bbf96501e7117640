"""What the processes say to each other: frozen, typed, stamped, in SI units and radians.

Rules of evolution: a field is never renamed or given another meaning; a new field has a default; a field that is not
needed any more stays. ``version`` counts up when a receiver must know the difference. Unknown fields are ignored, so
that older programs read newer messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

__all__ = [
    "LARGEST_NUMBER",
    "ActionMessage",
    "AskedMessage",
    "ComputedMessage",
    "FindingMessage",
    "HealthMessage",
    "LatentMessage",
    "Message",
    "ModelMessage",
    "NominalMessage",
    "ScanMessage",
    "SetupMessage",
    "StateMessage",
    "SurroundingsMessage",
    "TakeoverMessage",
    "VerdictMessage",
]

LARGEST_NUMBER = 1e12
"""No quantity of these robots comes near it, and with numbers below it no equation of a model overflows."""

Count = Annotated[int, Meta(ge=0)]
Number = Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
"""What is NaN, infinite or larger is refused on receipt."""
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST_NUMBER)]
"""Refused on receipt when it is 0 or below."""
Vector = tuple[Number, ...]
Rows = tuple[Vector, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """The stamp that every message carries."""

    version: Count = 2
    epoch: Count
    """Redrawn by the robot at each of its starts, carried along by everything computed from its states."""
    tick: Count
    """Counts the robot's periods from 0; the tick of the state from which this message was computed."""
    robot_time: Number
    """s since the robot's start, by the robot's clock."""
    publish_time: Number
    """s since 1970, by the sender's clock; for people and recordings, never for decisions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StateMessage(Message):
    """What the robot measures now, and what it perceives around it."""

    values: Vector
    """(states,) in the order of the robot's system."""
    applied: Vector
    """(actions,) the action in force over the period that ended now."""
    applied_by: str
    """Who chose it: ``filter``, ``watchdog`` (the robot braked by itself) or ``none`` (first tick)."""
    period: Positive
    """s between two ticks."""
    lockstep: bool
    """True when the robot waits for the action of this tick, however long it takes."""
    goal: Vector
    """Car: (2,) m; pendulum: (1,) rad; empty without one."""
    obstacles: Rows
    """(obstacles, 3): x, y, radius in m."""
    field: Vector
    """(4,): lowest x, highest x, lowest y, highest y in m; empty of a robot that does not drive."""
    footprint: Vector
    """(3,): how far the body (and what it tows) reaches behind and ahead of the reference point along the heading, and
    the radius around that line, in m; empty of a robot that does not drive."""
    load_pose: Vector = ()
    """(5,): x, y, yaw, length, width of a towed load, empty without one; for pictures only."""
    goals_reached: Count = 0
    collisions: Count = 0
    """Contacts of body or load with an obstacle or the field's wall since the start, or times that the corridor was
    left, each counted once."""
    corridor: Vector = ()
    """(2,) the angles between which the first entry of the state must stay, whose rate is the second; in rad, turns
    counted. Empty of a robot without one."""
    towed: Vector = ()
    """(3,) of what hangs on a hitch at the footprint's rear end: the net ways driven backwards after which it begins to
    leave the footprint, and after which it may stand at any angle, and how far it reaches from the hitch, in m. Empty
    of a robot that tows nothing."""
    until_action: Number = 0.0
    """s from the moment to which ``values`` belong until this tick's action is put in force, by the robot's own clock:
    how old the measurement is, and the time from sense to act. The last command stays until then. 0: none, as in
    lockstep, or not told."""
    distance_reversed: Number = -1.0
    """m that a robot with something ``towed`` was driven backwards, net of forwards, by its own odometry. -1: not told;
    then the filter counts itself, and one that was restarted has to take what is towed for folded up."""
    sources: tuple[str, ...] = ()
    """Names of the sensors that see its surroundings: each sends scans, ``obstacles`` is empty, and neither policy nor
    filter looks at ``field`` as something solid. Empty: ``obstacles`` and ``field`` are what there is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanMessage(Message):
    """One turn of a laser scanner, as it measured at ``robot_time``; ``tick`` is that of the last state before it."""

    source: str
    """Name of the sensor, one of the state's ``sources``."""
    mount: Vector
    """(3,) where it sits in the frame of the body: x ahead of the reference point, y to its left in m, and the yaw in
    rad of its own angle 0."""
    first_angle: Number
    """rad of the first ray, to the left of the sensor's own angle 0."""
    angle_step: Number
    """rad from one ray to the next; below 0 of a sensor that turns clockwise or is mounted upside down."""
    ranges: Vector
    """(rays,) m. Below 0: the ray measured nothing that can be believed; ``farthest`` or more: nothing came back."""
    nearest: Number
    """m; what is nearer is not seen."""
    farthest: Number
    """m; what is farther is not seen."""
    number: Count
    """Counts the scans of this sensor since the robot's start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputedMessage(Message):
    """What a service computed in one step, and from what: so a recording can be replayed through the same code."""

    step: Count = 0
    """Counts the service's steps for this robot since it met the robot, from 1; 0: not told. A number that is left out
    in a recording is a message that was lost on the way to it."""
    consumed: Rows = ()
    """(inputs, 2): of each input besides the state, in the order in which the service names them, the age in ticks of
    what was used and its publish time. A stale one has the age alone and 0; the age is -1 where there never was one."""
    skipped: Vector = ()
    """Ticks since the last step whose states the service took up, but did not step: a newer one came first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LatentMessage(ComputedMessage):
    """The adaptation's estimate of the model's free parameters."""

    model: str
    """Fingerprint of the model to whose latent this belongs."""
    values: Vector
    """(latents,)."""
    deviations: Vector
    """(latents,) standard deviations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurroundingsMessage(ComputedMessage):
    """What the sensors of a robot know of what is around it, moved to the moment of the tick's state.

    All in the frame of the state's position. Discs hold what is there for certain: noise, the room between two rays and
    the way since it was seen are within their radii.
    """

    points: Rows
    """(points, 3): x, y, radius in m of discs that cover what is at rest; nearest first."""
    movers: Rows
    """(movers, 6): x, y, radius in m, velocity along x and y in m/s, and the speed in m/s that it may have in any
    direction from now on; nearest first."""
    hidden: Rows
    """(places, 4): x, y, radius in m of places that no one sees, where something may stand that moves, and the speed in
    m/s that it may have."""
    ages: Vector
    """(sources,) s since each of the state's sources measured what was heard of it last; -1: nothing was heard. Of one
    that is switched off, the age of the oldest of the others: what is told rests on those."""
    problems: tuple[str, ...] = ()
    """What is wrong with a source, a sentence each; while there is one, what is told here is not believed."""
    scans: Rows = ()
    """(scans, 2): of each scan that was heard since the step before, in the order in which they came, which of the
    state's sources it is from and its number."""
    off: tuple[str, ...] = ()
    """Sources that are not listened to."""
    zones: tuple[str, ...] = ()
    """Kind and name of each zone that a person marked and that counts, such as ``closed dock``."""
    borders: Rows = ()
    """(vertices, 3): which of the zones, x and y in m; of so many zones as have 512 vertices, for pictures only."""
    ordered: str = ""
    """What a person switched while perception runs, and who it was last; empty: all is as its file says."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NominalMessage(ComputedMessage):
    """What the policy would do."""

    values: Vector
    """(actions,)."""
    controller: str
    model: str = ""
    """Fingerprint of the model in force; empty: not told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionMessage(Message):
    """What the robot shall do. Only the safety filter sends it."""

    values: Vector
    """(actions,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictMessage(ComputedMessage):
    """Why the action is what it is."""

    status: str
    sentence: str
    """The status in words, with the reason."""
    action: Vector
    nominal: Vector
    """Empty when there was none."""
    slack: Number
    """By how much the barrier condition had to be relaxed, in the barrier's unit; 0 when it holds."""
    active: tuple[str, ...]
    """Names of the barriers that bind."""
    h_now: Number
    """Smallest barrier value at the measured state."""
    h_next: Number
    """Smallest barrier value that the model predicts for the next state under the action."""
    margin: Number
    """epsilon by which the condition is tightened."""
    solver: str
    """Status of the QP solver."""
    microseconds: Number
    """Time that the decision took."""
    predicted: Rows = ()
    """(steps, states) predicted under the action held, one period apart; more than the next one not with every tick."""
    coverage: Number = -1.0
    """Share of the last 500 steps at most near a boundary after which the least barrier value of a kind lay not below
    its prediction by more than the margin, the least of all kinds; -1: no such step was watched yet."""
    promised: Number = -1.0
    """Share that the margin was calibrated for; -1: not told."""
    model: str = ""
    """Fingerprint of the model in force; empty: not told."""
    ordered: str = ""
    """Why the robot was ordered to stop; empty: it may drive."""
    stationary_for: Number = 0.0
    """s for which the robot has not moved though something is requested; 0: it moves, nothing is requested, or not told."""
    stationary_reason: str = ""
    """Why it stands, once it has for more than 5 s; empty before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthMessage(Message):
    """A heartbeat, sent by the working loop itself: it proves progress, not only life."""

    service: str
    pid: Count
    state: str
    """``ready`` (waiting for a robot), ``running`` or ``failing``."""
    detail: str = ""
    steps: Count = 0
    stale: Count = 0
    """Steps that ran without some input because it was missing or too old."""
    refused: Count = 0
    """Messages that were refused as malformed, foreign or out of order."""
    step_microseconds: Number = 0.0
    """Time of the last step."""
    model: str = ""
    """Fingerprint of the model in force for this robot; empty of a service without one."""
    software: str = ""
    """Version of safedpa that the service runs; empty: not told."""
    acknowledged: Count = 0
    """Recorder: messages that are known to be on disk."""
    free_bytes: Count = 0
    """Recorder: room left where it writes; 0: not told."""
    latencies: Vector = ()
    """Robot: s from publishing a state to accepting its action, by its own clock, of each tick since the last heartbeat
    (of the newest 100 at most)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingMessage(Message):
    """What the watch over the model says: once a second of robot time, and whenever something changes."""

    model: str
    """Fingerprint of the model in force."""
    stage: str
    """``learning`` (what the error usually is), ``watching``, ``raised`` (the error left its band), ``searching``,
    ``candidates`` (effects to accept or reject) or ``nothing`` (the search found no effect that explains it)."""
    sentence: str
    """The stage in words."""
    number: Count
    """Findings since the start; 0 while there was none."""
    error: Number
    """Open-loop error over one second of the last stretch, scaled like a report's ``heldout_error``."""
    band: Number
    """Upper edge of the error's calibrated band; 0 while learning."""
    evidence: Number
    """Natural logarithm of the sequential test's e-value."""
    threshold: Number
    """log(1 / alpha): the finding is raised where the evidence reaches it."""
    coverage: Number
    """Share of the last steps whose error stayed within the margin."""
    where: str
    """Where the model fails, in words; empty while it does not."""
    report: str = ""
    """report.json of the search as text; empty unless the stage is ``candidates`` or ``nothing``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelMessage(Message):
    """One step of a change of the model that a robot's services use; stamped with the newest state's tick."""

    step: str
    """``offer`` (load and check it, keep the old one), ``take`` (use it from ``from_tick`` on) or ``drop`` (forget
    the offer)."""
    change: Count
    """Counts up with every change that is offered."""
    fingerprint: str
    """Of the model offered."""
    replaces: str
    """Fingerprint of the model in force when it was offered."""
    document: str = ""
    """With ``offer``: the model file's text."""
    margin: str = ""
    """With ``offer``: the filter's margin for it, as JSON text; empty: the shipped one of this model, or none."""
    from_tick: Count = 0
    """With ``take``: the first tick, of this message's epoch, at which everyone uses it."""
    who: str = ""
    """Who asked for it."""
    why: str = ""
    """What was asked for; with ``drop``: why nothing came of it."""
    data: str = ""
    """Which stretch of which run it was learned from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeoverMessage(Message):
    """A service's answer to an offered model, stamped with the tick at which it came about."""

    service: str
    """Who answers."""
    change: Count
    """Number of the change that it answers."""
    fingerprint: str
    """Of the model that the answer is about."""
    state: str
    """``ready`` (loaded and checked), ``taken`` (in use from the stamp's tick on) or ``refused``."""
    reason: str = ""
    """Why it was refused."""
    expected_effect: str = ""
    """With ``ready``: what the change will do, such as to the filter's margin; empty: nothing to be told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupMessage(Message):
    """With what a process runs: said at its start and every five seconds, byte for byte the same."""

    service: str
    instance: str
    """Redrawn at each start of the process."""
    pid: Count
    software: str
    """Versions of safedpa and of what its numbers depend on, as JSON text."""
    options: str
    """The command line's options, as JSON text."""
    fingerprint: str = ""
    """Of the model with which it begins; empty of a process without one."""
    document: str = ""
    """That model's file. Weights of networks are named in it, with their digest."""
    settings: str = ""
    """Safety filter: its settings, as TOML text."""
    margin: str = ""
    """Safety filter: the margin for that model, as JSON text; empty: none was calibrated."""
    controller: str = ""
    """Policy: the name of its controller; empty: the one that the model allows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskedMessage(Message):
    """A request that the diagnosis was asked, and its answer, refused or not; ``status`` is left out."""

    do: str
    """``accept``, ``reject`` or ``roll_back``; empty of what was no request."""
    ok: bool
    sentence: str
    """What is done, or why it is refused."""
    effect: str = ""
    model: str = ""
    """Fingerprint of the model that the asker saw in force."""
    finding: Count = 0
    who: str = ""
    change: Count = 0
    """Number of the change that the answer is about."""
