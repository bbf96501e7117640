// A robot in JavaScript that speaks the bus: it reports its state 20 times a second, does what the safety filter says,
// and brakes by itself where no action of this very tick comes. Needs Node 18 and no package.
//
//     safedpa serve robot.toml --policy goal_seeker --listen tcp/127.0.0.1:7447     (robot = "car")
//     node robot.mjs 127.0.0.1 7447 fleet r1 10
//
// In place of a body it has the few lines of `move`. Prints one line of JSON at its end.

import { randomBytes } from "node:crypto";
import { pack, unpack } from "./msgpack.mjs";
import { Session } from "./zenoh.mjs";

const PERIOD = 0.05, WAITS = 0.9; // s; share of the period in which an action counts
const LOW = [-0.6, -0.34], HIGH = [2.0, 0.34], BRAKE = [0, 0]; // m/s, rad
const WHEELBASE = 0.32, GAIN = 5.0, STRONGEST = 4.5; // m, 1/s, m/s2
const [host, port, fleet, robot, seconds] = process.argv.slice(2);

const epoch = randomBytes(8).readBigUInt64BE() >> 11n; // drawn again at each start
const surroundings = {
  goal: [3, 0],
  obstacles: [[1.2, 0.15, 0.3]], // x, y, radius [m]
  field: [-4, 4, -4, 4],
  footprint: [0.08, 0.4, 0.12], // behind, ahead, radius [m]
};
const state = { x: -2, y: 0, yaw: 0, speed: 0 };
let tick = 0, applied = BRAKE, appliedBy = "none", answer = null, braked = 0, nearest = Infinity;

const session = await Session.open(host, Number(port), () => process.exit(3)); // the body's own watchdog brakes
session.subscribe(`safedpa/${fleet}/${robot}/action`, (payload) => {
  const action = unpack(payload);
  const mine = BigInt(action.epoch) === epoch && action.tick === tick; // from this start, and from this tick's state
  if (mine && fits(action.values)) answer = action.values;
});

function fits(values) {
  return values.length === 2 && values.every((value, k) => value >= LOW[k] - 1e-9 && value <= HIGH[k] + 1e-9);
}

function tell() {
  const whole = (value) => BigInt(value); // msgpack keeps whole numbers and others apart
  session.put(`safedpa/${fleet}/${robot}/state`, pack({
    version: whole(1), epoch, tick: whole(tick), robot_time: tick * PERIOD, publish_time: Date.now() / 1000,
    values: [state.x, state.y, state.yaw, state.speed], applied, applied_by: appliedBy, period: PERIOD,
    lockstep: false, ...surroundings,
  }));
}

// The body: a car with a servo of its speed. Yours is a motor driver.
function move([target, steer]) {
  for (let step = 0; step < 20; step++) {
    const pace = PERIOD / 20;
    state.x += pace * state.speed * Math.cos(state.yaw);
    state.y += pace * state.speed * Math.sin(state.yaw);
    state.yaw += (pace * state.speed * Math.tan(steer)) / WHEELBASE;
    state.speed += pace * Math.max(-STRONGEST, Math.min(STRONGEST, GAIN * (target - state.speed)));
  }
  for (const [x, y, radius] of surroundings.obstacles) {
    for (const ahead of [-0.08, 0.16, 0.4]) {
      const [px, py] = [state.x + ahead * Math.cos(state.yaw), state.y + ahead * Math.sin(state.yaw)];
      nearest = Math.min(nearest, Math.hypot(px - x, py - y) - radius - 0.12);
    }
  }
}

const start = performance.now();
const pause = (until) => new Promise((done) => setTimeout(done, Math.max(0, until - performance.now())));
for (const ticks = Math.round(Number(seconds) / PERIOD); tick < ticks; tick++) {
  const begin = start + 1000 * tick * PERIOD;
  answer = null;
  tell();
  await pause(begin + 1000 * WAITS * PERIOD);
  [applied, appliedBy] = answer ? [answer, "filter"] : [BRAKE, "watchdog"];
  braked += answer ? 0 : 1;
  move(applied);
  await pause(begin + 1000 * PERIOD);
}
session.close();
console.log(JSON.stringify({ ticks: tick, braked, x: state.x, y: state.y, nearest }));
