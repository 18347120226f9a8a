// The page's tasks and policies without a page, in Node:
//   node headless.js evaluate <task> <policy.npz> <episodes> [seed]   prints the success rate
//   node headless.js replay                                           reads an episode from standard input, as JSON
// A replay starts at qpos and qvel, takes the actions, and prints features, desired goal, outcome and the policy's actions.
import { readFileSync, readdirSync } from "node:fs";
import { gunzipSync } from "node:zlib";

import loadMujoco from "./vendor/mujoco.js";
import { Pilot, Policy } from "./policy.js";
import { EPISODE, Task, randomNumbers } from "./task.js";

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

function episode(task, pilot, random) {
  task.reset(random);
  pilot.reset();
  let action = null;
  for (let step = 0; step < EPISODE; step++) task.step((action = pilot.act()));
  if (!task.kind.liftSteps || !task.achieved()) return task.achieved();
  const [, , before] = task.objectPosition();
  for (let step = 0; step < task.kind.liftSteps; step++) task.step((action = task.liftAction(action)));
  return task.lifted(before);
}

async function evaluate([name, path, episodes, seed = "0"]) {
  const mujoco = await open(), task = new Task(mujoco, name), pilot = new Pilot(policyOf(path), task);
  const random = randomNumbers(Number(seed));
  let successes = 0;
  for (let index = 0; index < Number(episodes); index++) successes += episode(task, pilot, random);
  console.log(JSON.stringify({ task: name, mujoco: mujoco.mj_versionString(), episodes: Number(episodes), successes }));
}

async function replay() {
  const mujoco = await open();
  const results = JSON.parse(readFileSync(0, "utf8")).map(({ name, policy, qpos, qvel, goal, actions }) => {
    const task = new Task(mujoco, name);
    task.place(Float32Array.from(qpos), Float32Array.from(qvel));
    task.goal = goal.slice(0, 3);
    const pilot = new Pilot(policyOf(policy), task), features = [task.features()], answers = [];
    for (const action of actions) {
      answers.push(pilot.policy.act(pilot.observation()));
      pilot.remember(action);
      task.step(action);
      features.push(task.features());
    }
    const { start, startQpos } = task, last = { achieved: task.achieved(), distance: task.distance() };
    task.delete();
    return { start, startQpos: Array.from(startQpos), features, desired: task.desired(), answers, ...last };
  });
  console.log(JSON.stringify(results));
}

const [command, ...words] = process.argv.slice(2);
await { evaluate, replay }[command](words);
