"""The message types of the bus: frozen dataclasses with validated fields, in SI units and radians.

Compatibility rules: a field is never renamed and never changes its meaning. A new field has a default, and an obsolete
field stays. ``version`` is incremented when a receiver must be able to distinguish the two. Receivers ignore unknown
fields, so that older programs can read newer messages.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

LARGEST_NUMBER = 1e12
"""Largest magnitude that a received number may have."""
# No measured quantity of these robots comes near 1e12, and squares and products of such numbers stay far below the
# largest float (1.8e308): no model equation overflows on an accepted message.

Count = Annotated[int, Meta(ge=0)]
Number = Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
"""A finite number; NaN, infinity and larger magnitudes are rejected on receipt."""
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST_NUMBER)]
"""A number above 0; anything else is rejected on receipt."""
Vector = tuple[Number, ...]
Rows = tuple[Vector, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """The header fields that every message has."""

    version: Count = 2
    epoch: Count
    """Random number that the robot draws at each start. Everything computed from its states carries the same epoch."""
    tick: Count
    """Control period of the robot, counted from 0: the tick of the state from which this message was computed."""
    robot_time: Number
    """Time since the robot started in s, by the robot's clock."""
    publish_time: Number
    """Unix time of sending in s, by the sender's clock; for logs, and to check the rate of ``robot_time``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StateMessage(Message):
    """The measured state of a robot, and what it perceives around it."""

    values: Vector
    """(states,) in the order of the robot's system."""
    applied: Vector
    """(actions,) action applied during the period that has just ended."""
    applied_by: str
    """Source of ``applied``: ``filter``, ``watchdog`` (the robot braked by itself) or ``none`` (first tick)."""
    period: Positive
    """Control period in s."""
    lockstep: bool
    """True if the robot waits for the action of this tick, however long that takes."""
    goal: Vector
    """Car: (2,) in m; pendulum: (1,) in rad; empty without a goal."""
    obstacles: Rows
    """(obstacles, 3): x, y and radius in m."""
    field: Vector
    """(4,): minimum x, maximum x, minimum y and maximum y in m; empty for a robot that does not drive."""
    footprint: Vector
    """(3,): how far the body, with any towed load, extends behind and ahead of the reference point along the heading,
    and the radius around that segment, in m; empty for a robot that does not drive."""
    load_pose: Vector = ()
    """(5,): x, y, yaw, length and width of a towed load, for display only; empty without a load."""
    goals_reached: Count = 0
    collisions: Count = 0
    """Number of contacts of the body or load with an obstacle or the field boundary since the start, or number of
    times that the corridor was left."""
    corridor: Vector = ()
    """(2,): minimum and maximum angle in rad for the first state, whose rate is the second state. The angle is not
    wrapped. Empty for a robot without a corridor."""
    towed: Vector = ()
    """(3,) in m, for a load on a hitch at the rear end of the footprint: the net distance driven in reverse after which
    the load begins to leave the footprint, the net distance after which it can have any angle, and its reach from the
    hitch. Empty for a robot that tows nothing."""
    until_action: Number = 0.0
    """Time in s from the measurement of ``values`` until this tick's action is applied, by the robot's clock: the age
    of the measurement plus the sense-to-act latency. The previous action stays applied until then. 0: no delay (as in
    lockstep), or not reported."""
    distance_reversed: Number = -1.0
    """Net distance in m that a robot with ``towed`` has driven in reverse, by its own odometry. -1: not reported; the
    filter then integrates the distance itself, and after a restart has to assume that the load is fully folded."""
    sources: tuple[str, ...] = ()
    """Names of the sensors that observe the surroundings. Each sends scans, ``obstacles`` is empty, and neither policy
    nor filter treats the boundary of ``field`` as solid. Empty: ``obstacles`` and ``field`` describe everything."""
    pose: Vector = ()
    """(3,) x and y in m and heading in rad, for a robot with sensors whose ``values`` do not begin with them. Empty:
    they do."""


def header(state: StateMessage | None = None) -> dict[str, Any]:
    """Returns the header of a message that is computed from a state now; None: of one that belongs to no tick."""
    if state is None:
        return {"epoch": 0, "tick": 0, "robot_time": 0.0, "publish_time": time.time()}
    return {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": time.time()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanMessage(Message):
    """One scan of a laser scanner, measured at ``robot_time``; ``tick`` is that of the last state before it."""

    source: str
    """Name of the sensor, one of the state's ``sources``."""
    mount: Vector
    """(3,) pose of the sensor in the body frame: x ahead of the reference point and y to its left in m, and the yaw of
    the sensor's zero angle in rad."""
    first_angle: Number
    """Angle of the first ray in rad, counter-clockwise from the sensor's zero angle."""
    angle_step: Number
    """Angle between consecutive rays in rad; negative for a sensor that turns clockwise or is mounted upside down."""
    ranges: Vector
    """(rays,) in m. Negative: invalid measurement; ``farthest`` or more: no return."""
    nearest: Number
    """Minimum range in m; closer objects are not detected."""
    farthest: Number
    """Maximum range in m; more distant objects are not detected."""
    number: Count
    """Sequence number of the sensor's scans since the robot started."""
    free: Vector = ()
    """(rays,) in m. Distance up to which a ray without a return saw free space, such as the ground; empty: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputedMessage(Message):
    """Header of a computed message: which step produced it, from which inputs, so that a recording can be replayed."""

    step: Count = 0
    """Step number of the service for this robot, counted from 1 since the service first received its state; 0: not
    reported. A missing number in a recording is a message that the recorder did not receive."""
    consumed: Rows = ()
    """(inputs, 2): age in ticks and publish time of each input besides the state, in the service's order of inputs. A
    stale input has its age and a publish time of 0; an input that never arrived has age -1."""
    skipped: Vector = ()
    """Ticks since the last step whose states the service prepared but did not step, because a newer state arrived."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LatentMessage(ComputedMessage):
    """The adaptation's estimate of the model's latent parameters."""

    model: str
    """Fingerprint of the model to which the latent belongs."""
    values: Vector
    """(latents,)."""
    deviations: Vector
    """(latents,) standard deviations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurroundingsMessage(ComputedMessage):
    """What a robot's sensors know of its surroundings, propagated to the time of the tick's state.

    Coordinates are in the frame of the state's position. The radii include measurement noise, the gap between two rays
    and the motion since the measurement, so that each object lies inside its disc.
    """

    points: Rows
    """(points, 3): x, y and radius in m of discs that cover stationary objects; nearest first."""
    movers: Rows
    """(movers, 6): x, y and radius in m, velocity in x and y in m/s, and the maximum speed in m/s that the object may
    reach in any direction from now on; nearest first."""
    hidden: Rows
    """(places, 4): x, y and radius in m of occluded areas that may contain a moving object, and the maximum speed of
    that object in m/s."""
    ages: Vector
    """(sources,) age in s of the newest measurement of each of the state's sources; -1: none was received. For a
    source that is switched off: the largest age of the others, because the message relies on those."""
    problems: tuple[str, ...] = ()
    """Problems with the sources, one sentence each. While there is one, receivers must not trust this message."""
    scans: Rows = ()
    """(scans, 2): index of the source and sequence number of each scan received since the previous step, in order of
    arrival."""
    off: tuple[str, ...] = ()
    """Sources that are switched off."""
    zones: tuple[str, ...] = ()
    """Kind and name of each active zone marked by a person, such as ``closed dock``."""
    borders: Rows = ()
    """(vertices, 3): index of the zone, x and y in m, for display only; limited to 512 vertices."""
    ordered: str = ""
    """What an operator has switched at run time, and who did so last; empty: everything is as configured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NominalMessage(ComputedMessage):
    """The nominal action, proposed by the policy."""

    values: Vector
    """(actions,)."""
    controller: str
    model: str = ""
    """Fingerprint of the active model; empty: not reported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionMessage(Message):
    """The action that the robot applies. Only the safety filter sends it."""

    values: Vector
    """(actions,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictMessage(ComputedMessage):
    """The safety filter's decision and the reason for it."""

    status: str
    sentence: str
    """The status as a sentence, with the reason."""
    action: Vector
    nominal: Vector
    """Empty without a nominal action."""
    slack: Number
    """Amount by which the barrier condition was relaxed, in the barrier's unit; 0 if the condition holds."""
    active: tuple[str, ...]
    """Names of the active barrier constraints."""
    h_now: Number
    """Smallest barrier value at the measured state."""
    h_next: Number
    """Smallest barrier value that the model predicts for the next state under the action."""
    margin: Number
    """The margin epsilon by which the condition is tightened."""
    solver: str
    """Status of the QP solver."""
    microseconds: Number
    """Computation time of the decision in us."""
    predicted: Rows = ()
    """(steps, states) predicted with the action held constant, one period apart. Only some ticks have more than one
    step."""
    coverage: Number = -1.0
    """Empirical coverage of the margin over the last (at most 500) steps near a boundary: for each kind of barrier the
    share of steps in which the smallest value was not below its prediction by more than the margin, and of these the
    minimum over all kinds. -1: no such step yet."""
    promised: Number = -1.0
    """Coverage for which the margin was calibrated; -1: not reported."""
    model: str = ""
    """Fingerprint of the active model; empty: not reported."""
    ordered: str = ""
    """Reason of the stop order for this robot; empty: it may drive."""
    stationary_for: Number = 0.0
    """Time in s for which the robot has not moved although the nominal action asks for motion; 0: it moves, no motion
    is requested, or not reported."""
    stationary_reason: str = ""
    """Why the robot is stationary, once it has been for more than 5 s; empty before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthMessage(Message):
    """A heartbeat. The working loop sends it itself, so it proves progress and not only that the process exists."""

    service: str
    pid: Count
    state: str
    """``ready`` (waiting for a robot), ``running`` or ``failing``."""
    detail: str = ""
    steps: Count = 0
    stale: Count = 0
    """Number of steps that ran with a missing or stale input."""
    refused: Count = 0
    """Number of messages rejected as malformed, foreign or out of order."""
    step_microseconds: Number = 0.0
    """Duration of the last step in us."""
    model: str = ""
    """Fingerprint of the active model for this robot; empty for a service without a model."""
    software: str = ""
    """Version of safedpa that the service runs; empty: not reported."""
    acknowledged: Count = 0
    """Recorder: number of messages known to be on disk."""
    free_bytes: Count = 0
    """Recorder: free space in bytes where it writes; 0: not reported."""
    latencies: Vector = ()
    """Robot: latency in s from publishing a state to accepting its action, by its own clock, for each tick since the
    last heartbeat (the newest 100 at most)."""
    supervised: bool = False
    """Whether a supervisor started this process: there must then be a roster on the bus."""
    commands: str = ""
    """Gateway of a ROS 2 robot: type of the messages to its driver; empty for other services."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingMessage(Message):
    """The model monitor's result; sent once a second of robot time and on every change."""

    model: str
    """Fingerprint of the active model."""
    stage: str
    """``learning`` (estimating the usual error), ``watching``, ``raised`` (the error left its band), ``searching``,
    ``candidates`` (effects to accept or reject) or ``nothing`` (no effect found that explains the error)."""
    sentence: str
    """The stage as a sentence."""
    number: Count
    """Number of findings since the start; 0: none yet."""
    error: Number
    """Prediction error over the last second, scaled like ``heldout_error``; 0: not measured yet."""
    band: Number
    """Upper limit of the calibrated error band; 0 while learning."""
    evidence: Number
    """Natural logarithm of the sequential test's e-value."""
    threshold: Number
    """log(1 / alpha): the finding is raised when the evidence reaches this value."""
    coverage: Number
    """Share of the last steps whose error was within the margin."""
    where: str
    """Description of the region where the model fails; empty while it does not."""
    report: str = ""
    """Text of the search's report.json; empty unless the stage is ``candidates`` or ``nothing``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelMessage(Message):
    """One step of a model change for the services of a robot; has the tick of the newest state."""

    step: str
    """``offer`` (load and check it, keep the old one), ``take`` (use it from ``from_tick`` on) or ``drop`` (discard
    the offer)."""
    change: Count
    """Number of the change; incremented with every offer."""
    fingerprint: str
    """Fingerprint of the offered model."""
    replaces: str
    """Fingerprint of the model that was active when this one was offered."""
    document: str = ""
    """With ``offer``: text of the model file."""
    margin: str = ""
    """With ``offer``: the filter's margin for the model as JSON; empty: the margin shipped with this model, or none."""
    from_tick: Count = 0
    """With ``take``: the first tick of this message's epoch at which all services use the model."""
    who: str = ""
    """Who requested the change."""
    why: str = ""
    """What was requested; with ``drop``: why the change was abandoned."""
    data: str = ""
    """Run and time range from which the model was learned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeoverMessage(Message):
    """A service's answer to a step of a model change, with the tick at which it took effect."""

    service: str
    """The answering service."""
    change: Count
    """Number of the change."""
    fingerprint: str
    """Fingerprint of the model that the answer is about."""
    state: str
    """``ready`` (loaded and checked), ``taken`` (in use from this message's tick on) or ``refused``."""
    reason: str = ""
    """Why it was refused."""
    expected_effect: str = ""
    """With ``ready``: the expected effect of the change, such as on the filter's margin; empty: none to report."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupMessage(Message):
    """The configuration of a process; sent at its start and every five seconds, always with identical bytes."""

    service: str
    instance: str
    """Random identifier, drawn at each start of the process."""
    pid: Count
    software: str
    """Versions of safedpa and of the packages that affect its numerical results, as JSON."""
    options: str
    """Command line options as JSON."""
    fingerprint: str = ""
    """Fingerprint of the initial model; empty for a process without a model."""
    document: str = ""
    """Text of that model's file. It refers to network weights by file name and digest."""
    settings: str = ""
    """Safety filter: its settings as TOML."""
    margin: str = ""
    """Safety filter: the margin for that model as JSON; empty: none was calibrated."""
    controller: str = ""
    """Policy: name of its controller; empty: the one that the model allows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskedMessage(Message):
    """A request to the diagnosis and its answer, whether granted or refused; ``status`` requests are left out."""

    do: str
    """``accept``, ``reject`` or ``roll_back``; empty if the payload was not a request."""
    ok: bool
    sentence: str
    """What will be done, or why the request was refused."""
    effect: str = ""
    model: str = ""
    """Fingerprint of the model that was active for the requester."""
    finding: Count = 0
    who: str = ""
    change: Count = 0
    """Number of the change that the answer is about."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RosterEntry:
    """A robot or service that should be on the bus."""

    kind: str
    """``robot`` or ``service``."""
    name: str
    silent_for: Number = -1.0
    """Age in s, at sending, of its last state (robot) or heartbeat (service); -1: none was received."""
    restarts: Count = 0
    """How often the supervisor restarted it in this run."""
    cause: str = ""
    """Why it ended last; empty: it never did."""
    given_up: bool = False
    """Whether it is no longer restarted, because it ended too often."""
    dismissed_by: str = ""
    """Who declared that it is not expected any more; empty: it is expected. Its return clears this."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RosterMessage(Message):
    """Who should be on the bus, sent twice a second by a supervisor; or a dismissal, sent once by a person."""

    source: str
    """Random identifier of the supervisor's run; of a dismissal, of the command."""
    entries: tuple[RosterEntry, ...] = ()
    ended: bool = False
    """Whether the supervisor ends its run in order: nothing of this source is expected any more."""
    dismisses: tuple[str, ...] = ()
    """Names of robots and services that are not expected any more until they return."""
    who: str = ""
    """Who dismisses them."""
