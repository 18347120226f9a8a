// The Fetch tasks once more: start, control, features, goals and success, as in envs/hgail_envs/tasks.
// A test holds them to Python's. Positions are metres in the world's frame, times seconds.

export const PERIOD = 0.04; // between two actions
export const SUBSTEPS = 20; // physics steps per action

const LEAD = 0.05; // by which the mocap body leads the gripper for a unit action
export const THRESHOLD = 0.05; // largest distance that is a success
const DOWNWARD = [1, 0, 1, 0]; // points the gripper at the table
const BASE_Y = 0.48;
const GRIPPER_OFFSET = [-0.498, 0.005, -0.431]; // from the gripper's outstretched position to the table
const SETTLE_PERIODS = 10;
const LEAST_DISTANCE = 0.1; // in the plane, between the starts of gripper and objects
const CUBE_WIDTH = 0.05, CUBE_HEIGHT = 0.425, GAP_TOLERANCE = 0.008, LEAST_RISE = 0.05, HIGHEST = 0.45;
const MOST_ASIDE = 0.025, MOST_HIGH = 0.01; // of a cube from its place on another, in the plane and in height
const LEAST_AWAY = 0.05, LEAST_GAP = 0.08, AT_REST = 0.05; // of a hand that has let go of a cube, and the cube's speed
const FINGERS = ["right_finger", "left_finger"];

// `object` is brought to the target; `carrier` is the object at, or on, whose place the target is.
const COMMON = { baseX: 0.405, height: 0.2, objectRange: 0.15, range: 0.15, offset: 0, episode: 50, liftSteps: 0 };

export const TASKS = {
  reach: { ...COMMON, scene: "reach" },
  grasp: { ...COMMON, scene: "grasp", object: "cube", hand: true, carrier: "cube", liftSteps: 12 },
  push: { ...COMMON, scene: "push", object: "cube", height: 0 },
  "pick-and-place": { ...COMMON, scene: "grasp", object: "cube", hand: true, air: true },
  slide: {
    ...COMMON, scene: "slide", object: "puck", baseX: 0.05, height: -0.02, objectRange: 0.1, range: 0.3, offset: 0.4,
  },
  stack: { ...COMMON, scene: "stack", object: "cube_a", hand: true, carrier: "cube_b", episode: 100, liftSteps: 12 },
};

// Returns a generator of uniform numbers in [0, 1), mulberry32.
export function randomNumbers(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 4294967296;
  };
}

export const distance = (one, other) => Math.hypot(...one.map((value, axis) => value - other[axis]));
const add = (one, other) => one.map((value, axis) => value + other[axis]);
const clip = (value) => Math.min(1, Math.max(-1, value));

export class Task {
  // `mujoco` is the loaded module, in whose file system `/scenes` has the MJCF files.
  constructor(mujoco, name) {
    this.name = name;
    this.kind = TASKS[name];
    this.mujoco = mujoco;
    this.model = mujoco.MjModel.from_xml_path(`/scenes/${this.kind.scene}.xml`);
    this.data = new mujoco.MjData(this.model);
    this.grip = this.model.site("grip").id;
    this.body = this.model.body("gripper").id;
    this.fingers = FINGERS.map((finger) => this.address("qposadr", finger));
    if (this.kind.object) {
      this.object = this.#objectOf(this.kind.object);
      this.carrier = this.kind.carrier && this.#objectOf(this.kind.carrier);
    }
    this.velocity = new mujoco.DoubleBuffer(6);
    this.#settle();
  }

  delete() {
    this.velocity.delete();
    this.data.delete();
    this.model.delete();
  }

  address(kind, joint) {
    return this.model[`jnt_${kind}`][this.model.jnt(joint).id];
  }

  // Returns where an object's position and velocity begin in qpos and qvel, and its body.
  #objectOf(name) {
    return { at: this.address("qposadr", name), velocityAt: this.address("dofadr", name), body: this.model.body(name).id };
  }

  // Whether the object itself is the target, as in grasp.
  get targetIsObject() {
    return this.kind.carrier && this.kind.carrier === this.kind.object;
  }

  // Whether the target is on another object, as in stack.
  get stacks() {
    return this.kind.carrier && this.kind.carrier !== this.kind.object;
  }

  // Brings the arm to its start, as the reference does: pulls the gripper there and lets it settle.
  #settle() {
    const { mujoco, model, data, kind } = this;
    data.qpos[this.address("qposadr", "base_x")] = kind.baseX;
    data.qpos[this.address("qposadr", "base_y")] = BASE_Y;
    mujoco.mj_forward(model, data);
    const outstretched = Array.from(data.site_xpos.subarray(3 * this.grip, 3 * this.grip + 3));
    data.mocap_pos.set(add(add(outstretched, GRIPPER_OFFSET), [0, 0, kind.height]));
    data.mocap_quat.set(DOWNWARD);
    for (let step = 0; step < SETTLE_PERIODS * SUBSTEPS; step++) mujoco.mj_step(model, data);
    this.startQpos = Float32Array.from(data.qpos);
    this.startQvel = Float32Array.from(data.qvel);
    mujoco.mj_forward(model, data);
    this.start = Array.from(data.site_xpos.subarray(3 * this.grip, 3 * this.grip + 3));
    this.objectHeight = kind.object ? this.startQpos[this.object.at + 2] : 0;
    if (this.targetIsObject) this.objectHeight = CUBE_HEIGHT;
    this.place(this.startQpos, this.startQvel);
  }

  // Starts an episode; `random` is a generator of `randomNumbers`.
  reset(random) {
    const { kind, start } = this;
    const qpos = Float32Array.from(this.startQpos);
    const places = [];
    for (const { at } of this.objects) {
      places.push(this.#randomPlace(random, places));
      qpos.set([...places.at(-1), this.objectHeight], at);
    }
    this.place(qpos, this.startQvel);
    const aside = () => kind.range * (2 * random() - 1);
    if (kind.carrier) this.goal = this.#placeAtCarrier();
    else if (!kind.object) this.goal = add(start, [aside(), aside(), aside()]);
    else this.goal = [start[0] + kind.offset + aside(), start[1] + aside(), this.objectHeight];
    if (kind.air && random() < 0.5) this.goal[2] += HIGHEST * random();
  }

  // The objects that a start places.
  get objects() {
    return [this.object, this.stacks && this.carrier].filter(Boolean);
  }

  // Draws a place on the table, away from the gripper and from `others`.
  #randomPlace(random, others) {
    const middle = this.start.slice(0, 2);
    for (;;) {
      const place = middle.map((value) => value + this.kind.objectRange * (2 * random() - 1));
      if ([middle, ...others].every((other) => distance(place, other) >= LEAST_DISTANCE)) return place;
    }
  }

  #placeAtCarrier() {
    return add(this.position(this.carrier), [0, 0, this.#rise]);
  }

  // Of a target above the object that carries it.
  get #rise() {
    return this.stacks ? CUBE_WIDTH : 0;
  }

  // Lowest and highest position of the target.
  get bounds() {
    const { kind, start } = this;
    const middle = [start[0] + kind.offset, start[1], kind.object ? this.objectHeight + this.#rise : start[2]];
    const [below, above] = kind.object ? [0, kind.air ? HIGHEST : 0] : [kind.range, kind.range];
    return [add(middle, [-kind.range, -kind.range, -below]), add(middle, [kind.range, kind.range, above])];
  }

  // Moves the target, as near to a position as its bounds allow, and what carries it, which is put down there. Returns
  // whether it was moved: a cube that is to carry another is not put down where that one lies.
  moveTarget(position) {
    const [low, high] = this.bounds, goal = position.map((value, axis) => Math.min(high[axis], Math.max(low[axis], value)));
    if (this.stacks && this.#isTaken(goal)) return false;
    this.goal = goal;
    if (!this.carrier) return true;
    const { at, velocityAt } = this.carrier;
    this.data.qpos.set([...add(goal, [0, 0, -this.#rise]), 1, 0, 0, 0], at);
    this.data.qvel.fill(0, velocityAt, velocityAt + 6);
    this.cubesTouch = false;
    if (this.targetIsObject) this.touches = false;
    this.#observe();
    return true;
  }

  // Whether the object leaves no room for another below a goal.
  #isTaken(goal) {
    const object = this.objectPosition();
    return distance(object.slice(0, 2), goal.slice(0, 2)) < LEAST_DISTANCE && object[2] < goal[2] - MOST_HIGH;
  }

  // Sets joint positions and velocities before any step.
  place(qpos, qvel) {
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
    this.data.xfrc_applied.fill(0);
    this.touches = this.cubesTouch = false;
    this.#observe();
  }

  // Pushes the object for the next action with a force, newtons.
  push(force) {
    this.data.xfrc_applied.set(force, 6 * this.object.body);
  }

  // An action is begin, SUBSTEPS times substep, then end; a viewer spreads the steps over its frames.
  begin(action) {
    const { data, kind } = this;
    const displacement = action.slice(0, 3).map(clip);
    data.mocap_pos.set(this.bodyPosition.map((value, axis) => value + LEAD * displacement[axis]));
    data.mocap_quat.set(this.bodyQuaternion.map((value, index) => value + DOWNWARD[index]));
    if (kind.hand) data.ctrl.set(this.fingers.map((finger) => data.qpos[finger] + clip(action[3])));
    data.qacc_warmstart.fill(0); // as Python's engine, which keeps no state between actions
  }

  substep() {
    this.mujoco.mj_step(this.model, this.data);
  }

  end() {
    const { data } = this;
    const [right, left, cubes] = data.sensordata;
    this.touches = this.kind.hand && right > 0 && left > 0;
    this.cubesTouch = cubes > 0;
    if (!this.kind.hand) for (const finger of this.fingers) data.qpos[finger] = 0; // they are blocked
    data.xfrc_applied.fill(0);
    this.#observe();
  }

  step(action) {
    this.begin(action);
    for (let step = 0; step < SUBSTEPS; step++) this.substep();
    this.end();
  }

  #observe() {
    const { mujoco, model, data } = this;
    data.qpos.set(Float32Array.from(data.qpos)); // Python's state is single precision
    data.qvel.set(Float32Array.from(data.qvel));
    mujoco.mj_kinematics(model, data);
    mujoco.mj_comPos(model, data);
    mujoco.mj_comVel(model, data);
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE.value, this.grip, this.velocity, 0);
    this.gripper = Array.from(data.site_xpos.subarray(3 * this.grip, 3 * this.grip + 3));
    this.gripperVelocity = Array.from(this.velocity.GetView().subarray(3)).map((value) => value * PERIOD);
    this.bodyPosition = Array.from(data.xpos.subarray(3 * this.body, 3 * this.body + 3));
    this.bodyQuaternion = Array.from(data.xquat.subarray(4 * this.body, 4 * this.body + 4));
  }

  position({ at }) {
    return Array.from(this.data.qpos.subarray(at, at + 3));
  }

  // Metres per action.
  #velocity({ velocityAt }) {
    return Array.from(this.data.qvel.subarray(velocityAt, velocityAt + 3)).map((value) => value * PERIOD);
  }

  objectPosition() {
    return this.position(this.object);
  }

  // Position of what is dragged to move the target.
  targetPosition() {
    return this.carrier ? this.position(this.carrier) : this.goal;
  }

  get gap() {
    return this.fingers.reduce((sum, finger) => sum + this.data.qpos[finger], 0);
  }

  get holding() {
    return this.touches && Math.abs(this.gap - CUBE_WIDTH) <= GAP_TOLERANCE;
  }

  // The observation without the goal.
  features() {
    const hand = this.kind.hand ? [this.gap, Number(this.holding)] : [];
    const ofObject = this.object && !this.targetIsObject ? this.#featuresOf(this.object) : [];
    const ofCarrier = this.stacks ? this.#featuresOf(this.carrier) : [];
    return [...this.gripper, ...this.gripperVelocity, ...ofObject, ...hand, ...ofCarrier];
  }

  // The numbers that a policy of pictures has beside them: what the robot measures in itself, and the goal.
  known() {
    return [...this.gripper, ...this.gripperVelocity, ...(this.kind.hand ? [this.gap] : []), ...this.desired()];
  }

  #featuresOf(object) {
    const position = this.position(object), relative = position.map((value, axis) => value - this.gripper[axis]);
    return [...relative, ...position, ...this.#velocity(object)];
  }

  // The goal as the policy sees it: a position, and in tasks with an object that the goal is the object's, or held; in
  // stack that it is cube A's, not cube B's, and that A is left there.
  desired() {
    if (this.stacks) return [...this.goal, 1, 0, 1];
    return this.kind.object ? [...this.goal, 1] : this.goal;
  }

  // Distance between the target and what is to be there.
  distance() {
    const { kind } = this;
    if (this.targetIsObject) return distance(this.gripper, this.objectPosition());
    return distance(kind.object ? this.objectPosition() : this.gripper, this.goal);
  }

  // Whether the present state achieves the goal; in grasp and stack the lift test follows.
  achieved() {
    if (this.targetIsObject) return this.holding;
    return this.stacks ? this.#isLeft && this.#stands : this.distance() <= THRESHOLD;
  }

  // Whether the object rests where the hand has let go of it.
  get #isLeft() {
    const away = distance(this.gripper, this.objectPosition()) >= LEAST_AWAY && this.gap >= LEAST_GAP;
    return away && Math.hypot(...this.#velocity(this.object)) <= AT_REST * PERIOD;
  }

  // Whether the object is at the goal, and on the one that carries it, wherever the hand is.
  get #stands() {
    const object = this.objectPosition();
    const isAt = (place) =>
      distance(object.slice(0, 2), place.slice(0, 2)) <= MOST_ASIDE && Math.abs(object[2] - place[2]) <= MOST_HIGH;
    return this.cubesTouch && isAt(this.goal) && isAt(this.#placeAtCarrier());
  }

  // The action of a step of the lift test, given the one before; in stack the hand keeps still and open.
  liftAction(action) {
    return this.stacks ? [0, 0, 0, 1] : [0, 0, 1, action[3]];
  }

  // Whether the object is up after the lift test; in stack whether it stands.
  lifted() {
    return this.stacks ? this.#stands : this.objectPosition()[2] - CUBE_HEIGHT > LEAST_RISE;
  }

  // Starts an episode from joint positions and velocities and a goal, as the tests give them.
  startFrom({ qpos, qvel, goal }) {
    this.place(Float32Array.from(qpos), Float32Array.from(qvel));
    this.goal = goal.slice(0, 3);
  }

  // Whether a pilot succeeds from there, at once and without a viewer.
  succeeds(pilot, start) {
    this.startFrom(start);
    pilot.reset();
    let action = null;
    for (let step = 0; step < this.kind.episode; step++) this.step((action = pilot.act()));
    if (!this.kind.liftSteps || !this.achieved()) return this.achieved();
    for (let step = 0; step < this.kind.liftSteps; step++) this.step((action = this.liftAction(action)));
    return this.lifted();
  }
}
