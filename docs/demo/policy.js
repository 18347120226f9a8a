// Reads the policies that this project ships, and computes their mean actions; see hgail_jax/io/policy.py.

const EPSILON = 1e-6; // of layer normalisation

// Returns the arrays of an npz archive that is not compressed, by name: { shape, values }.
export function readNpz(buffer) {
  const view = new DataView(buffer), arrays = {};
  let end = buffer.byteLength - 22;
  while (view.getUint32(end, true) !== 0x06054b50) end--; // the directory's end, behind which only a comment may stand
  let entry = view.getUint32(end + 16, true);
  for (let count = view.getUint16(end + 10, true); count > 0; count--) {
    if (view.getUint16(entry + 10, true) !== 0) throw new Error("a policy's archive must not be compressed");
    const nameLength = view.getUint16(entry + 28, true), local = view.getUint32(entry + 42, true);
    const name = text(buffer, entry + 46, nameLength);
    const first = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    arrays[name.replace(/\.npy$/, "")] = readNpy(buffer, first);
    entry += 46 + nameLength + view.getUint16(entry + 30, true) + view.getUint16(entry + 32, true);
  }
  return arrays;
}

function text(buffer, first, length) {
  return new TextDecoder().decode(new Uint8Array(buffer, first, length));
}

function readNpy(buffer, first) {
  const view = new DataView(buffer, first), long = view.getUint8(6) > 1;
  const length = long ? view.getUint32(8, true) : view.getUint16(8, true), start = long ? 12 : 10;
  const header = text(buffer, first + start, length);
  const [, type] = header.match(/'descr': '([^']+)'/), [, sizes] = header.match(/'shape': \(([^)]*)\)/);
  const shape = sizes.split(",").filter((size) => size.trim()).map(Number);
  const count = shape.reduce((product, size) => product * size, 1), data = first + start + length;
  if (type === "<f4") return { shape, values: new Float32Array(buffer.slice(data, data + 4 * count)) };
  if (type.startsWith("<U")) {
    const codes = new Uint32Array(buffer.slice(data, data + 4 * Number(type.slice(2))));
    return { shape, values: Array.from(codes, (code) => String.fromCodePoint(code)).join("").replace(/\0+$/, "") };
  }
  throw new Error(`a policy has no array of type ${type}`);
}

export class Policy {
  constructor(buffer) {
    const arrays = readNpz(buffer);
    this.header = JSON.parse(arrays.header.values);
    if (this.header.format !== "hgail_jax policy 2") throw new Error(`unknown format ${this.header.format}`);
    this.mean = arrays.mean.values;
    this.std = arrays.std.values;
    this.layers = Array.from({ length: this.header.layers }, (_, index) => {
      const [weights, biases, scale, offset] = ["weights", "biases", "scale", "offset"].map(
        (name) => arrays[`${name}_${index}`]?.values,
      );
      return { weights, biases, scale, offset };
    });
    this.history = this.header.randomization?.history ?? 0;
  }

  // Returns the mean action for an observation.
  act(observation) {
    const { clip } = this.header.observation;
    let hidden = Array.from(observation, (value, index) =>
      Math.min(clip, Math.max(-clip, (value - this.mean[index]) / this.std[index])),
    );
    this.layers.forEach((layer, index) => {
      hidden = linear(hidden, layer);
      if (index + 1 < this.layers.length) hidden = layer.scale ? normalised(hidden, layer) : hidden.map(Math.tanh);
    });
    const { low, high } = this.header.action;
    return hidden.map((value) => (this.header.squash ? Math.tanh(value) : Math.min(high, Math.max(low, value))));
  }
}

function linear(inputs, { weights, biases }) {
  const outputs = Array.from(biases), width = outputs.length;
  inputs.forEach((input, row) => {
    for (let column = 0; column < width; column++) outputs[column] += input * weights[row * width + column];
  });
  return outputs;
}

// Layer normalisation, then ReLU.
function normalised(values, { scale, offset }) {
  const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
  const variance = values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / values.length;
  const deviation = Math.sqrt(variance + EPSILON);
  return values.map((value, index) => Math.max(0, ((value - mean) / deviation) * scale[index] + offset[index]));
}

// A policy at work on a task: it keeps the last actions and features, which a robust policy observes too.
export class Pilot {
  constructor(policy, task) {
    this.policy = policy;
    this.task = task;
    this.reset();
  }

  reset() {
    const first = [...new Array(this.policy.header.action.size).fill(0), ...this.task.features()];
    this.past = new Array(this.policy.history).fill(first);
  }

  observation() {
    return [...this.past.flat(), ...this.task.features(), ...this.task.desired()];
  }

  // Returns the action for the present state.
  act() {
    const action = this.policy.act(this.observation());
    this.remember(action);
    return action;
  }

  // Puts an action, and the features that it answers, at the head of the history.
  remember(action) {
    this.past = [[...action, ...this.task.features()], ...this.past].slice(0, this.policy.history);
  }
}
