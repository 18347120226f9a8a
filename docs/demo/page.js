// The page: an episode's phases, the controls, and the loop that steps and draws.
import loadMujoco from "./vendor/mujoco.js";
import { Eyes } from "./eyes.js";
import { pilotOf, readPolicy } from "./policy.js";
import { PERIOD, SUBSTEPS, THRESHOLD, Task, randomNumbers } from "./task.js";
import { Viewer } from "./viewer.js";

const TIMESTEP = PERIOD / SUBSTEPS;
const REST = 1; // seconds that the scene stands still after an episode
const MOST_BEHIND = 0.06; // seconds of simulation in a frame; a slow device falls behind the clock
const SLOW_MOTION = 0.25;
const STEP = 0.02; // metres that a key moves the target
const NUDGE = { cube: 1.1, cube_a: 1.1, puck: 0.35 }; // metres per second, after which the object slides 6 cm
const PULL = { stiffness: 500, damping: 60, most: 70 }; // of a pointer on an object: N/m, N s/m, N
const LIMIT = 10; // metres, beyond which the simulation broke down
const KINDS = ["robust", "camera"]; // of policies that some tasks have beside the plain one
const HINTS = {
  reach: "Drag the ball, or its ring on the table: the hand follows.",
  grasp: "Drag the cube over the table: the hand fetches it.",
  push: "Drag the ring over the table: the hand pushes the cube there.",
  "pick-and-place": "Drag the ball up, or its ring over the table: the hand brings the cube.",
  slide: "Drag the ring: the hand shoots the puck there. It does not always succeed.",
  stack: "Drag the green cube over the table: the hand puts the yellow one on it.",
};

const find = (id) => document.getElementById(id);

// A policy at work, action by action, on a target that can be moved at any time.
class Session {
  constructor(task, pilot, seed) {
    this.task = task;
    this.pilot = pilot;
    this.random = randomNumbers(seed);
    this.episodes = this.successes = 0;
    this.restart();
  }

  // Lets go of the target and starts the next episode.
  restart() {
    this.held = null;
    this.#begin();
  }

  #begin() {
    do this.task.reset(this.random);
    while (this.held && !this.task.moveTarget(this.held)); // until the start leaves room for it
    this.pilot.reset();
    this.#act();
    this.substeps = 0; // of the present action; 0 is between two actions
  }

  #act() {
    this.phase = "acting";
    this.clock = 0;
    this.success = null;
    this.follows = false; // the goal follows a cube that was nudged
  }

  moveTarget(position) {
    this.#finishAction();
    this.held = position;
    if (this.task.targetIsObject && (this.phase === "lifting" || this.phase === "resting")) {
      this.#begin(); // a lift test leaves the arm where no episode takes it
      return;
    }
    this.task.moveTarget(position);
    this.held = this.task.goal;
    this.#act();
  }

  // Gives the object a push, so that it slides a few centimetres.
  nudge() {
    const { task } = this, speed = NUDGE[task.kind.object], angle = 2 * Math.PI * this.random();
    this.#finishAction();
    task.data.qvel.set([speed * Math.cos(angle), speed * Math.sin(angle)], task.object.velocityAt);
    if (this.phase === "resting" || this.phase === "lifting") return;
    this.#act();
    this.follows = task.targetIsObject;
  }

  #finishAction() {
    while (this.substeps) this.substep();
  }

  substep() {
    if (this.phase === "resting") {
      this.clock += TIMESTEP;
      if (this.clock >= REST) this.#begin();
      return;
    }
    if (!this.substeps) this.#beginAction();
    this.task.substep();
    this.substeps++;
    if (this.substeps < SUBSTEPS) return;
    this.substeps = 0;
    this.task.end();
    this.clock++;
    const { qpos } = this.task.data;
    if (!qpos.every((value) => Math.abs(value) <= LIMIT)) this.#begin();
    else this.#judge();
  }

  #beginAction() {
    if (this.follows) this.task.goal = this.task.objectPosition();
    const lifts = this.phase === "lifting";
    this.action = lifts ? this.task.liftAction(this.action) : this.pilot.act();
    this.task.begin(this.action);
    if (this.pull) this.task.push(this.pull(this.task));
  }

  #judge() {
    const { task } = this;
    if (this.phase === "acting" && this.clock === task.kind.episode) {
      if (task.kind.liftSteps && task.achieved()) {
        this.phase = "lifting";
        this.clock = 0;
      } else this.#conclude(!task.kind.liftSteps && task.achieved());
    } else if (this.phase === "lifting" && this.clock === task.kind.liftSteps) this.#conclude(task.lifted());
  }

  // Counts the episode, and stays at a target that was moved by hand, or rests.
  #conclude(success) {
    this.episodes++;
    this.successes += success;
    this.success = success;
    const stays = success && this.held && !this.task.kind.liftSteps;
    this.phase = stays ? "staying" : "resting";
    this.clock = 0;
  }

  get reached() {
    return this.success === null || this.phase === "staying" ? this.task.achieved() : this.success;
  }
}

class Page {
  constructor(mujoco, content) {
    this.mujoco = mujoco;
    this.content = content;
    this.canvas = find("scene");
    this.viewer = new Viewer(this.canvas);
    this.policies = {};
    this.speed = 1;
    this.due = 0;
    this.seed = 1;
    this.frames = this.simulated = 0;
    this.drags = false; // whether a pointer drags the target
    this.paused = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.visible = true;
    new IntersectionObserver(([entry]) => (this.visible = entry.isIntersecting)).observe(this.canvas);
  }

  // `kind` is one of KINDS, or nothing for the plain policy.
  async setTask(name, kind = "") {
    const asked = (this.asked = kind ? `${name}-${kind}` : name);
    let policy;
    try {
      policy = await this.#policy(asked);
    } catch (error) {
      if (!this.session) throw error;
      this.#showControls(); // of the task that is shown still
      find("hint").textContent = `That policy did not load; choose it again. ${error.message}`;
      return;
    }
    if (this.asked !== asked) return; // meanwhile another was chosen
    this.session?.task.delete();
    const task = new Task(this.mujoco, name);
    if (kind === "camera") this.eyes ??= new Eyes();
    this.session = new Session(task, pilotOf(policy, task, this.eyes), this.seed++);
    this.viewer.show(task);
    this.kind = kind;
    this.due = 0;
    this.#showControls();
    this.viewer.draw(false, false);
    this.#showStatus();
  }

  async #policy(name) {
    this.policies[name] ??= readPolicy(await download(`policies/${name}.npz`));
    return this.policies[name];
  }

  #showControls() {
    const { name, kind } = this.session.task;
    find(name).checked = true;
    for (const each of KINDS) {
      find(each).parentElement.hidden = !this.content.policies.includes(`${name}-${each}`);
      find(each).checked = each === this.kind;
    }
    find("seen").hidden = this.kind !== "camera";
    find("nudge").hidden = !kind.object;
    find("nudge").textContent = kind.object === "puck" ? "Nudge the puck" : "Nudge the cube";
    find("hint").textContent = HINTS[name];
    const keys = kind.air || !kind.object ? "arrow keys, Page Up and Page Down" : "arrow keys";
    this.canvas.setAttribute("aria-label", `The Fetch arm at ${name}. ${HINTS[name]} The ${keys} move the target too.`);
    this.#showPause();
  }

  #showPause() {
    find("pause").textContent = this.paused ? "Play" : "Pause";
  }

  #showStatus() {
    const { session } = this, status = find("status"), centimetres = (100 * session.task.distance()).toFixed(1);
    const testing = session.task.targetIsObject ? "Lifting it, as a test" : "Letting it stand, as a test";
    const words = this.paused ? "Paused" : session.success === false ? "Missed; once more"
      : session.success && session.reached ? "Success" : session.phase === "lifting" ? testing
      : session.reached ? (session.task.targetIsObject ? "Holding it" : "At the target") : "On its way";
    status.dataset.state = session.reached && !this.paused ? "good" : session.success === false ? "bad" : "busy";
    find("standing").textContent = words;
    find("distance").textContent = session.task.targetIsObject ? `Hand and cube ${centimetres} cm apart`
      : `${centimetres} cm away` + (session.task.stacks ? "" : `; success within ${100 * THRESHOLD} cm`);
    find("count").textContent = session.episodes ? `${session.successes} of ${session.episodes} episodes succeeded` : "First episode";
    const ended = session.success === null ? "" : session.success ? "Success." : "Missed.";
    if (find("news").textContent !== ended) find("news").textContent = ended; // read aloud once per episode
  }

  // Shows the pictures that a policy saw last, side by side.
  #showSeen() {
    const { seen, policy } = this.session.pilot;
    if (!seen || seen === this.shown) return;
    const { cameras, size } = policy.header.pictures, context = find("pictures").getContext("2d");
    Object.assign(context.canvas, { width: cameras.length * size, height: size });
    cameras.forEach((_, index) => context.putImageData(imageOf(seen.subarray(3 * size * size * index), size), size * index, 0));
    this.shown = seen;
  }

  restart() {
    this.session.restart();
  }

  setPaused(paused) {
    this.paused = paused;
    this.#showPause();
    this.#showStatus();
  }

  moveTarget(position) {
    this.session.moveTarget(position);
    this.due = 0;
  }

  // Steps the physics by the time that has passed, and draws.
  frame(seconds) {
    if (!this.session || !this.visible) return;
    if (!this.paused) {
      this.due = Math.min(this.due + this.speed * seconds, MOST_BEHIND);
      const steps = Math.floor(this.due / TIMESTEP);
      for (let step = 0; step < steps; step++) this.session.substep();
      this.due -= steps * TIMESTEP;
      this.simulated += steps * TIMESTEP;
    }
    this.viewer.draw(this.session.reached, this.drags);
    this.viewer.adapt(seconds);
    this.#showSeen();
    const { phase, episodes } = this.session, stage = `${phase} ${episodes}`;
    if (this.frames++ % 6 === 0 || stage !== this.stage) this.#showStatus();
    this.stage = stage;
  }

  connect() {
    for (const input of document.querySelectorAll("input[name=task]"))
      input.addEventListener("change", () => this.setTask(input.id));
    document.querySelector("form").addEventListener("submit", (event) => event.preventDefault());
    for (const kind of KINDS)
      find(kind).addEventListener("change", ({ target }) => this.setTask(this.session.task.name, target.checked ? kind : ""));
    find("restart").addEventListener("click", () => this.restart());
    find("pause").addEventListener("click", () => this.setPaused(!this.paused));
    find("nudge").addEventListener("click", () => this.session.nudge());
    find("slow").addEventListener("change", (event) => (this.speed = event.target.checked ? SLOW_MOTION : 1));
    this.#connectKeys();
    this.#connectPointers();
    let last = performance.now();
    const frame = (now) => {
      this.frame(Math.max(0, now - last) / 1000);
      last = now;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  #connectKeys() {
    // To the right, away from the viewer, and up.
    const moves = {
      ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0], ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], PageUp: [0, 0, 1], PageDown: [0, 0, -1],
    };
    this.canvas.addEventListener("keydown", (event) => {
      const from = this.session.task.targetPosition();
      if (event.key === " ") this.setPaused(!this.paused);
      else if (moves[event.key]) {
        const [right, away, up] = moves[event.key], { azimuth } = this.viewer.view, along = [Math.cos(azimuth), Math.sin(azimuth)];
        const by = [along[0] * away + along[1] * right, along[1] * away - along[0] * right, up];
        this.moveTarget(from.map((value, axis) => value + STEP * by[axis]));
      } else return;
      event.preventDefault();
    });
  }

  #connectPointers() {
    const { canvas, viewer } = this, pointers = new Map(), pixel = (event) => [event.offsetX, event.offsetY];
    const embedded = window.self !== window.top;
    let touched = null;
    canvas.style.touchAction = embedded ? "pan-y" : "none"; // a page around this one scrolls under a finger
    const start = (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, pixel(event));
      if (pointers.size > 1) return;
      touched = viewer.touched(pixel(event));
      if (touched === "object") this.#pull(pixel(event));
      this.drags = touched === "target" || touched === "foot";
    };
    const move = (event) => {
      const before = pointers.get(event.pointerId), now = pixel(event);
      if (!before) {
        canvas.style.cursor = viewer.touched(now) ? "grab" : "";
        return;
      }
      if (touched) this.#drag(touched, now);
      else if (pointers.size === 1) viewer.orbit(-(now[0] - before[0]) * 0.006, -(now[1] - before[1]) * 0.004);
      else {
        const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
        const width = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
        viewer.orbit(0, 0, width(before) / Math.max(1, width(now)));
      }
      pointers.set(event.pointerId, now);
    };
    const end = (event) => {
      pointers.delete(event.pointerId);
      if (pointers.size) return;
      touched = null;
      this.drags = false;
      this.session.pull = null;
    };
    canvas.addEventListener("pointerdown", start);
    canvas.addEventListener("pointermove", move);
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("dblclick", () => viewer.lookHome());
    // A finger on the target drags it, and does not scroll the page around this one.
    canvas.addEventListener("touchstart", (event) => touched && event.preventDefault(), { passive: false });
    canvas.addEventListener("wheel", (event) => {
      if (embedded && !event.ctrlKey) return;
      event.preventDefault();
      viewer.orbit(0, 0, Math.exp(event.deltaY * 0.001));
    }, { passive: false });
  }

  #drag(touched, pixel) {
    const { task } = this.session;
    if (touched === "object") return this.#pull(pixel);
    const from = task.targetPosition();
    const isLevel = touched === "foot" || (task.kind.object && !task.kind.air);
    const plane = touched === "foot" ? [from[0], from[1], 0.4] : from;
    const position = this.viewer.under(pixel, plane, isLevel);
    if (position) this.moveTarget(touched === "foot" ? [position[0], position[1], from[2]] : position);
  }

  // Pulls the object towards a pixel, like a spring, over the table.
  #pull(pixel) {
    const towards = this.viewer.under(pixel, this.session.task.objectPosition(), true);
    if (!towards) return;
    this.session.pull = (task) => {
      const [x, y] = task.objectPosition(), [u, v] = task.data.qvel.subarray(task.object.velocityAt);
      const force = [PULL.stiffness * (towards[0] - x) - PULL.damping * u, PULL.stiffness * (towards[1] - y) - PULL.damping * v];
      const scale = Math.min(1, PULL.most / (Math.hypot(...force) || 1));
      return [scale * force[0], scale * force[1], 0];
    };
  }
}

// Returns a picture, [size, size, 3] at the head of `seen`, as a canvas has it.
function imageOf(seen, size) {
  const image = new ImageData(size, size);
  for (let pixel = 0; pixel < size * size; pixel++) image.data.set([...seen.subarray(3 * pixel, 3 * pixel + 3), 255], 4 * pixel);
  return image;
}

async function download(path) {
  const answer = await fetch(new URL(path, import.meta.url));
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.arrayBuffer();
}

// Returns the WebAssembly, which the build compressed, since not every host does; a host may have undone that.
async function wasm() {
  const bytes = await download("vendor/mujoco.wasm.gz");
  if (new Uint8Array(bytes, 0, 1)[0] !== 0x1f) return bytes;
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function open() {
  const [wasmBinary, content] = await Promise.all([
    wasm(),
    download("content.json").then((bytes) => JSON.parse(new TextDecoder().decode(bytes))),
  ]);
  const [mujoco, ...scenes] = await Promise.all([
    loadMujoco({ wasmBinary }),
    ...content.scenes.map((name) => download(`scenes/${name}`)),
  ]);
  mujoco.FS.mkdir("/scenes");
  content.scenes.forEach((name, index) => mujoco.FS.writeFile(`/scenes/${name}`, new Uint8Array(scenes[index])));
  const page = new Page(mujoco, content);
  const asked = new URLSearchParams(location.search).get("task");
  await page.setTask(asked in HINTS ? asked : "reach");
  page.connect();
  // The page's own handle, for tests and the curious.
  window.demo = {
    setTask: (name, kind) => page.setTask(name, kind),
    setTarget: (position) => page.moveTarget(position),
    status: () => {
      const { session } = page, { phase, success, episodes, successes } = session;
      const { task } = session, distance = task.distance(), { goal, bounds } = task, object = task.object && task.objectPosition();
      const { frames, simulated } = page;
      return { task: task.name, phase, success, episodes, successes, distance, goal, bounds, object, frames, simulated };
    },
    pixel: (position) => page.viewer.project(position),
    session: () => page.session,
  };
  document.body.dataset.ready = "true";
}

open().catch((error) => {
  find("standing").textContent = "This browser cannot show it";
  find("hint").textContent = String(error.message ?? error);
  throw error;
});
