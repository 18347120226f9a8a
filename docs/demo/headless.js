// The page's tasks and policies without a page, in Node; tests compare them with Python's. `node headless.js evaluate` runs
// the policies from given starts and prints which episodes succeed; `node headless.js replay` takes given actions and
// prints what is observed, and the policies' actions for given observations; `node headless.js look` prints what a policy of
// pictures makes of given ones. All read a list from standard input, as JSON.
import { readFileSync, readdirSync } from "node:fs";
import { gunzipSync } from "node:zlib";

import loadMujoco from "./vendor/mujoco.js";
import { pilotOf, readPolicy } from "./policy.js";
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
  return readPolicy(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
}

function evaluate(mujoco, { task: name, policy, starts }) {
  const task = new Task(mujoco, name), pilot = pilotOf(policyOf(policy), task);
  return starts.map((start) => task.succeeds(pilot, start));
}

function replay(mujoco, { task: name, policy, start, actions, asked }) {
  const task = new Task(mujoco, name);
  task.startFrom(start);
  const pilot = pilotOf(policyOf(policy), task), observations = [pilot.observation()], known = [task.known()], achieved = [];
  for (const action of actions) {
    pilot.remember(action);
    task.step(action);
    observations.push(pilot.observation());
    known.push(task.known());
    achieved.push(task.achieved());
  }
  const { start: gripper, startQpos } = task, answers = asked.map((observation) => pilot.policy.act(observation));
  const distance = task.distance(), { bounds } = task;
  return { gripper, qpos: Array.from(startQpos), bounds, observations, known, answers, achieved, distance };
}

// What a policy of pictures does, and where it sees the objects, for given pictures and numbers.
function look(_, { policy: path, pictures, numbers }) {
  const policy = policyOf(path);
  return pictures.map((each, index) => policy.look(Uint8Array.from(each), numbers[index]));
}

const mujoco = await open(), command = { evaluate, replay, look }[process.argv[2]];
const results = JSON.parse(readFileSync(0, "utf8")).map((each) => command(mujoco, each));
console.log(JSON.stringify(results));
