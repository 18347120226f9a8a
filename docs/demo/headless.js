// The page's tasks and policies without a page, in Node; tests compare them with Python's. `node headless.js evaluate` runs
// the policies from given starts and prints which episodes succeed; `node headless.js replay` takes given actions and
// prints what is observed, and the policies' actions for given observations. Both read a list from standard input, as JSON.
import { readFileSync, readdirSync } from "node:fs";
import { gunzipSync } from "node:zlib";

import loadMujoco from "./vendor/mujoco.js";
import { Pilot, Policy } from "./policy.js";
import { Task } from "./task.js";

const here = (path) => new URL(path, import.meta.url);

async function open() {
  const wasmBinary = gunzipSync(readFileSync(here("vendor/mujoco.wasm.gz")));
  const mujoco = await loadMujoco({ wasmBinary });
  mujoco.FS.mkdir("/scenes");
  for (const name of readdirSync(here("scenes"))) mujoco.FS.writeFile(`/scenes/${name}`, readFileSync(here(`scenes/${name}`)));
  return mujoco;
}

function policyOf(path) {
  const bytes = readFileSync(path);
  return new Policy(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
}

function begin(task, { qpos, qvel, goal }) {
  task.place(Float32Array.from(qpos), Float32Array.from(qvel));
  task.goal = goal.slice(0, 3);
}

function succeeds(task, pilot, start) {
  begin(task, start);
  pilot.reset();
  let action = null;
  for (let step = 0; step < task.kind.episode; step++) task.step((action = pilot.act()));
  if (!task.kind.liftSteps || !task.achieved()) return task.achieved();
  const [, , before] = task.objectPosition();
  for (let step = 0; step < task.kind.liftSteps; step++) task.step((action = task.liftAction(action)));
  return task.lifted(before);
}

function evaluate(mujoco, { task: name, policy, starts }) {
  const task = new Task(mujoco, name), pilot = new Pilot(policyOf(policy), task);
  return starts.map((start) => succeeds(task, pilot, start));
}

function replay(mujoco, { task: name, policy, start, actions, asked }) {
  const task = new Task(mujoco, name);
  begin(task, start);
  const pilot = new Pilot(policyOf(policy), task), observations = [pilot.observation()], achieved = [];
  for (const action of actions) {
    pilot.remember(action);
    task.step(action);
    observations.push(pilot.observation());
    achieved.push(task.achieved());
  }
  const { start: gripper, startQpos } = task, answers = asked.map((observation) => pilot.policy.act(observation));
  const distance = task.distance(), { bounds } = task;
  return { gripper, qpos: Array.from(startQpos), bounds, observations, answers, achieved, distance };
}

const mujoco = await open(), command = { evaluate, replay }[process.argv[2]];
const results = JSON.parse(readFileSync(0, "utf8")).map((each) => command(mujoco, each));
console.log(JSON.stringify(results));
