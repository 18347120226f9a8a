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

// Returns the policy of a file, of positions or of pictures.
export function readPolicy(buffer) {
  const arrays = readNpz(buffer), header = JSON.parse(arrays.header.values);
  const kind = { "hgail_jax policy 2": Policy, "hgail_jax camera policy 1": CameraPolicy }[header.format];
  if (!kind) throw new Error(`unknown format ${header.format}`);
  return new kind(header, arrays);
}

function layersOf(header, arrays) {
  return Array.from({ length: header.layers }, (_, index) => {
    const [weights, biases, scale, offset] = ["weights", "biases", "scale", "offset"].map(
      (name) => arrays[`${name}_${index}`]?.values,
    );
    return { weights, biases, scale, offset };
  });
}

class Policy {
  constructor(header, arrays) {
    this.header = header;
    this.mean = arrays.mean.values;
    this.std = arrays.std.values;
    this.layers = layersOf(header, arrays);
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

const STRIDES = [2, 2, 1, 1]; // of the convolutions, as in hgail_jax/vision/network.py
const OBJECT_SCALE = 0.1; // metres that a 1 of the objects' positions stands for

// A policy that sees pictures, uint8 [cameras, size, size, 3], the robot's own numbers and the goal's.
class CameraPolicy {
  constructor(header, arrays) {
    if (header.pictures.kind) throw new Error(`the policy sees ${header.pictures.kind}, and the page draws colours`);
    this.header = header;
    this.mean = arrays.mean.values;
    this.std = arrays.std.values;
    this.centre = arrays.centre.values;
    this.convolutions = STRIDES.map((stride, index) => {
      const kernel = arrays[`kernel_${index}`], [edge, , inputs, outputs] = kernel.shape;
      if (outputs % 2) throw new Error("a convolution must have an even number of features"); // see convolved
      return { stride, edge, inputs, outputs, kernel: turned(kernel), biases: arrays[`kernel_biases_${index}`].values };
    });
    this.layers = layersOf(header, arrays);
    this.heads = ["action", "objects"].map((head) => ({
      weights: arrays[`${head}_weights`].values, biases: arrays[`${head}_biases`].values,
    }));
  }

  // Returns the action, and where the objects are, metres.
  look(pictures, numbers) {
    if (numbers.length !== this.mean.length) throw new Error(`the policy takes ${this.mean.length} numbers, not ${numbers.length}`);
    let { cameras, size } = this.header.pictures, seen = sideBySide(pictures, cameras.length, size);
    for (const convolution of this.convolutions) {
      seen = convolved(seen, size, convolution);
      size = Math.ceil(size / convolution.stride);
    }
    const known = Array.from(numbers, (value, index) => (value - this.mean[index]) / this.std[index]);
    let hidden = [...placesOf(seen, size), ...known];
    for (const layer of this.layers) hidden = normalised(linear(hidden, layer), layer);
    const [action, objects] = this.heads.map((head) => linear(hidden, head));
    return { action: action.map(Math.tanh), objects: objects.map((value, axis) => this.centre[axis] + OBJECT_SCALE * value) };
  }
}

// Returns pictures as [size, size, 3 cameras], from -.5 to .5.
function sideBySide(pictures, cameras, size) {
  const pixels = size * size, seen = new Float32Array(pictures.length);
  for (let from = 0; from < pictures.length; from++) {
    const camera = Math.floor(from / (3 * pixels)), pixel = Math.floor(from / 3) % pixels;
    seen[3 * (pixel * cameras + camera) + (from % 3)] = pictures[from] / 255 - 0.5;
  }
  return seen;
}

// Returns a convolution of [size, size, inputs], with zeros around it, and ReLU: [width, width, outputs].
function convolved(seen, size, { stride, edge, inputs, outputs, kernel, biases }) {
  const width = Math.ceil(size / stride), before = Math.max((width - 1) * stride + edge - size, 0) >> 1;
  const full = size + edge, row = full * inputs, framed = new Float32Array(full * row), result = new Float32Array(width * width * outputs);
  for (let y = 0; y < size; y++)
    framed.set(seen.subarray(y * size * inputs, (y + 1) * size * inputs), (y + before) * row + before * inputs);
  // Four pixels and two features at a time: a number that is loaded is used twice or four times, in a third of the time.
  const next = stride * inputs, run = edge * inputs, weights = edge * run;
  for (let y = 0; y < width; y++)
    for (let x = 0; x < width; x += 4)
      for (let feature = 0; feature < outputs; feature += 2) {
        let a = biases[feature], b = a, c = a, d = a, e = biases[feature + 1], f = e, g = e, h = e;
        let weight = feature * weights;
        for (let down = 0; down < edge; down++) {
          let at = (y * stride + down) * row + x * next;
          for (const end = at + run; at < end; at++, weight++) {
            const one = kernel[weight], other = kernel[weight + weights];
            const p = framed[at], q = framed[at + next], r = framed[at + 2 * next], s = framed[at + 3 * next];
            a += one * p, b += one * q, c += one * r, d += one * s;
            e += other * p, f += other * q, g += other * r, h += other * s;
          }
        }
        const to = (y * width + x) * outputs + feature; // past the row's end the next row overwrites it
        result[to] = a, result[to + outputs] = b, result[to + 2 * outputs] = c, result[to + 3 * outputs] = d;
        result[to + 1] = e, result[to + outputs + 1] = f, result[to + 2 * outputs + 1] = g, result[to + 3 * outputs + 1] = h;
      }
  return result.map((value) => Math.max(0, value));
}

// Returns a kernel's numbers in the order in which they are used: those of an output side by side.
function turned({ shape, values }) {
  const outputs = shape[3], inputs = values.length / outputs;
  return values.map((_, at) => values[(at % inputs) * outputs + Math.floor(at / inputs)]);
}

// Returns the mean place of each feature of [size, size, features] by a softmax: all y, then all x, from -1 to 1.
function placesOf(seen, size) {
  const features = seen.length / (size * size), y = new Array(features), x = new Array(features);
  for (let feature = 0; feature < features; feature++) {
    let most = -Infinity, sum = 0, down = 0, right = 0;
    for (let at = feature; at < seen.length; at += features) most = Math.max(most, seen[at]);
    for (let pixel = 0; pixel < size * size; pixel++) {
      const weight = Math.exp(seen[pixel * features + feature] - most);
      sum += weight;
      down += weight * Math.floor(pixel / size);
      right += weight * (pixel % size);
    }
    y[feature] = (2 * down) / sum / (size - 1) - 1;
    x[feature] = (2 * right) / sum / (size - 1) - 1;
  }
  return [...y, ...x];
}

// A policy of positions at work on a task: it keeps the last actions and features, which a robust policy observes too.
class Pilot {
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

// A policy of pictures at work on a task; `eyes` look at its scene.
class CameraPilot {
  constructor(policy, task, eyes) {
    const { cameras, size } = policy.header.pictures;
    Object.assign(this, { policy, task, eyes });
    eyes.show(task, cameras, size);
  }

  reset() {
    this.seen = this.eyes.look();
  }

  act() {
    this.seen = this.eyes.look();
    return this.policy.look(this.seen, this.task.known()).action;
  }
}

// Returns a policy at work on a task; one of pictures needs Eyes.
export function pilotOf(policy, task, eyes) {
  return policy instanceof CameraPolicy ? new CameraPilot(policy, task, eyes) : new Pilot(policy, task);
}
