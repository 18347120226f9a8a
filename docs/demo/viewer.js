// Draws a scene with three.js from the geoms of its MjModel, and finds what a pointer touches.
import * as THREE from "./vendor/three.module.js";
import { RoundedBoxGeometry } from "./vendor/RoundedBoxGeometry.js";

const HIDDEN_GROUP = 4; // of geoms that only collide
const SHAPE = { plane: 0, sphere: 2, capsule: 3, cylinder: 5, box: 6 }; // mjtGeom
const COLOURS = { sky: 0xeaf0f6, floor: 0xdfe6ee, target: 0xe5352b, success: 0x1f9d57, border: 0x2358a6 };
const TABLE = 0.4015; // metres, a little above the table's top
const ROUNDING = 0.006; // metres
const TOUCH_RADIUS = 34; // pixels around the target that count as touching it, for fingers
const RATIOS = { least: 0.4, most: 2 }; // drawn pixels per pixel of the page
const SMOOTH = 1 / 40, SLOW = 1 / 33; // seconds per frame, between which the resolution stays as it is

// Whether a processor draws in place of a graphics card: then smoothing costs more than a finer picture.
function drawsInSoftware() {
  const context = document.createElement("canvas").getContext("webgl");
  const name = context?.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL;
  const found = name ? context.getParameter(name) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(found);
}

// Returns the shape of a geom in its own frame; a box's edges are rounded.
export function geometryOf(model, geom, rounding) {
  const [a, b, c] = model.geom_size.subarray(3 * geom, 3 * geom + 3);
  const shapes = {
    [SHAPE.plane]: () => new THREE.CircleGeometry(12, 48),
    [SHAPE.sphere]: () => new THREE.SphereGeometry(a, 24, 16),
    [SHAPE.capsule]: () => new THREE.CapsuleGeometry(a, 2 * b, 6, 20).rotateX(Math.PI / 2),
    [SHAPE.cylinder]: () => new THREE.CylinderGeometry(a, a, 2 * b, 36).rotateX(Math.PI / 2),
    [SHAPE.box]: () => new RoundedBoxGeometry(2 * a, 2 * b, 2 * c, 2, Math.min(rounding, a / 2, b / 2, c / 2)),
  };
  return shapes[model.geom_type[geom]]();
}

export class Viewer {
  constructor(canvas) {
    this.canvas = canvas;
    this.isSoftware = drawsInSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.isSoftware, powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = this.isSoftware ? THREE.BasicShadowMap : THREE.PCFShadowMap;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(COLOURS.sky);
    this.scene.fog = new THREE.Fog(COLOURS.sky);
    this.camera = new THREE.PerspectiveCamera(34, 1, 0.1, 30);
    this.camera.up.set(0, 0, 1);
    this.view = { azimuth: 0, elevation: 0, distance: 0, centre: new THREE.Vector3() };
    this.ratio = Math.min(RATIOS.most, window.devicePixelRatio);
    this.frameTime = SMOOTH;
    this.raycaster = new THREE.Raycaster();
    this.#light();
    this.#addMark();
  }

  #light() {
    const sun = new THREE.DirectionalLight(0xfff4e6, 2.1);
    sun.position.set(2.4, -0.6, 3.4);
    sun.target.position.set(1.1, 0.75, 0.4);
    sun.castShadow = true;
    sun.shadow.mapSize.setScalar(this.isSoftware ? 512 : 1024);
    sun.shadow.radius = 3;
    sun.shadow.bias = -0.0006;
    sun.shadow.normalBias = 0.004;
    Object.assign(sun.shadow.camera, { left: -1.3, right: 1.3, top: 1.3, bottom: -1.3, near: 1, far: 6 });
    this.scene.add(sun, sun.target, new THREE.HemisphereLight(0xffffff, 0xb8c2cc, 1.7));
    const fill = new THREE.DirectionalLight(0xdbe8ff, 0.5);
    fill.position.set(1.5, 3, 1.5);
    this.scene.add(fill);
  }

  // The target: a ball with the zone of success around it, its foot on the table, and a stem between them.
  #addMark() {
    const material = (opacity) => new THREE.MeshBasicMaterial({ transparent: true, opacity, depthTest: false }); // seen through the hand
    const ball = new THREE.Mesh(new THREE.SphereGeometry(0.022, 24, 16), new THREE.MeshLambertMaterial());
    const zone = new THREE.Mesh(new THREE.SphereGeometry(0.05, 32, 20), material(0.16));
    const ring = new THREE.Mesh(new THREE.RingGeometry(0.046, 0.054, 48), material(0.9));
    const disc = new THREE.Mesh(new THREE.CircleGeometry(0.046, 48), material(0.18));
    const stem = new THREE.Mesh(new THREE.CylinderGeometry(0.0025, 0.0025, 1, 8).rotateX(Math.PI / 2), material(0.45));
    this.mark = { ball, zone, ring, disc, stem };
    const box = new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1));
    this.border = new THREE.LineSegments(box, new THREE.LineBasicMaterial({ color: COLOURS.border, transparent: true }));
    this.scene.add(...Object.values(this.mark), this.border);
  }

  // Shows where the target can be; more plainly while it is dragged.
  #placeBorder(isDragged) {
    const [low, high] = this.task.bounds, { border } = this;
    const isFlat = high[2] - low[2] < 0.001, bottom = isFlat ? TABLE : low[2];
    border.position.set((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, isFlat ? TABLE : (bottom + high[2]) / 2);
    border.scale.set(high[0] - low[0], high[1] - low[1], isFlat ? 0.0001 : high[2] - bottom);
    border.material.opacity = isDragged ? 0.9 : 0.25;
  }

  // Shows another scene; `task` is a Task.
  show(task) {
    this.bodies?.traverse((each) => {
      each.geometry?.dispose();
      each.material?.dispose();
    });
    this.bodies?.removeFromParent();
    this.bodies = new THREE.Group();
    this.meshes = [];
    for (let geom = 0; geom < task.model.ngeom; geom++) {
      const mesh = this.#mesh(task.model, geom);
      if (!mesh) continue;
      mesh.matrixAutoUpdate = false;
      mesh.userData = { geom, body: task.model.geom_bodyid[geom] };
      this.meshes.push(mesh);
      this.bodies.add(mesh);
    }
    this.scene.add(this.bodies);
    this.task = task;
    const far = task.name === "slide";
    this.home = { azimuth: 2.3, elevation: -0.4, distance: far ? 2.6 : 2.15, centre: far ? [1.22, 0.74, 0.44] : [1.1, 0.69, 0.62] };
    this.lookHome();
  }

  #mesh(model, geom) {
    if (model.geom_group[geom] === HIDDEN_GROUP) return null;
    const material = model.geom_matid[geom], isFloor = model.geom_type[geom] === SHAPE.plane;
    const [red, green, blue] = material < 0 ? model.geom_rgba.subarray(4 * geom) : model.mat_rgba.subarray(4 * material);
    const colour = new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace);
    if (isFloor) colour.set(COLOURS.floor);
    const mesh = new THREE.Mesh(geometryOf(model, geom, ROUNDING), this.#material(colour, isFloor));
    mesh.castShadow = !isFloor;
    mesh.receiveShadow = !(isFloor && this.isSoftware); // most of the picture's pixels are the floor's
    return mesh;
  }

  #material(color, isFloor) {
    if (isFloor || this.isSoftware) return new THREE.MeshLambertMaterial({ color });
    return new THREE.MeshPhongMaterial({ color, shininess: 40, specular: 0x222222 });
  }

  lookHome() {
    const { centre, ...angles } = this.home;
    Object.assign(this.view, angles);
    this.view.centre.set(...centre);
  }

  // Turns the camera by angles, and brings it nearer or farther by a factor.
  orbit(azimuth, elevation, factor = 1) {
    const { view, home } = this, limit = (value, low, high) => Math.min(high, Math.max(low, value));
    view.azimuth += azimuth;
    view.elevation = limit(view.elevation + elevation, -1.45, -0.06);
    view.distance = limit(view.distance * factor, home.distance / 3, home.distance * 1.6);
  }

  #placeCamera() {
    const { azimuth, elevation, distance, centre } = this.view, width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const ratio = this.ratio, size = this.renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height || this.renderer.getPixelRatio() !== ratio) {
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height, false);
    }
    this.camera.aspect = width / height;
    const away = distance * Math.max(1, 1.15 / this.camera.aspect); // a narrow window shows as much
    Object.assign(this.scene.fog, { near: away + 1.8, far: away + 6 }); // behind the robot, however far the camera is
    const flat = Math.cos(elevation) * away;
    this.camera.position.set(
      centre.x - flat * Math.cos(azimuth), centre.y - flat * Math.sin(azimuth), centre.z - away * Math.sin(elevation),
    );
    this.camera.lookAt(centre);
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
  }

  // Draws the present state; `reached` colours the target, and a dragged one shows its border.
  draw(reached, isDragged) {
    const { data } = this.task;
    for (const mesh of this.meshes) {
      const { geom } = mesh.userData, [x, y, z] = data.geom_xpos.subarray(3 * geom), m = data.geom_xmat.subarray(9 * geom);
      mesh.matrix.set(m[0], m[1], m[2], x, m[3], m[4], m[5], y, m[6], m[7], m[8], z, 0, 0, 0, 1);
      mesh.matrixWorldNeedsUpdate = true;
    }
    this.#placeMark(reached);
    this.#placeBorder(isDragged);
    this.#placeCamera();
    this.renderer.render(this.scene, this.camera);
  }

  #placeMark(reached) {
    const { ball, zone, ring, disc, stem } = this.mark, { kind } = this.task, table = TABLE;
    const [x, y, z] = this.task.targetIsObject ? this.task.objectPosition() : this.task.goal;
    const isHigh = !kind.object || Boolean(kind.air);
    for (const part of Object.values(this.mark)) {
      part.material.color.set(reached ? COLOURS.success : COLOURS.target);
      part.position.set(x, y, table);
    }
    ball.visible = isHigh;
    zone.visible = isHigh;
    stem.visible = isHigh && z > table + 0.03;
    disc.visible = !kind.carrier; // it would veil a cube
    ball.position.z = zone.position.z = z;
    stem.position.z = (z + table) / 2;
    stem.scale.z = Math.max(0.001, z - table);
  }

  // Adapts the resolution to the time that frames take; a first frame or one after a pause says nothing.
  adapt(seconds) {
    if (seconds > 0.25) return;
    this.frameTime += 0.08 * (seconds - this.frameTime);
    const most = Math.min(RATIOS.most, window.devicePixelRatio);
    if (this.frameTime > SLOW) this.ratio = Math.max(RATIOS.least, this.ratio * 0.97);
    else if (this.frameTime < SMOOTH && this.ratio < most) this.ratio = Math.min(most, this.ratio * 1.003);
    this.ratio = Math.round(this.ratio * 1000) / 1000;
  }

  // Returns the pixel of a position, relative to the canvas.
  project(position) {
    const { x, y } = new THREE.Vector3(...position).project(this.camera);
    return [((1 + x) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  #aim([x, y]) {
    const pointer = new THREE.Vector2((2 * x) / this.canvas.clientWidth - 1, 1 - (2 * y) / this.canvas.clientHeight);
    this.raycaster.setFromCamera(pointer, this.camera);
  }

  // Returns what a pixel touches: "target", "foot" (of the target, on the table), "object", or null.
  touched(pixel) {
    const { task } = this, near = (position) => Math.hypot(...this.project(position).map((at, axis) => at - pixel[axis]));
    const foot = [task.goal[0], task.goal[1], 0.4];
    this.#aim(pixel);
    const [first] = this.raycaster.intersectObjects(this.meshes);
    const isOn = (object) => object && first?.object.userData.body === object.body;
    if (task.carrier) {
      if (!task.targetIsObject && isOn(task.object)) return "object";
      return isOn(task.carrier) || near(task.targetPosition()) < TOUCH_RADIUS ? "target" : null;
    }
    if (this.mark.ball.visible && near(task.goal) < TOUCH_RADIUS) return "target";
    if (isOn(task.object)) return "object";
    if (near(foot) < TOUCH_RADIUS) return this.mark.ball.visible ? "foot" : "target";
    return null;
  }

  // Returns the position under a pixel in a plane through a position: level, or facing the camera; null beyond it.
  under(pixel, position, isLevel) {
    this.#aim(pixel);
    const normal = isLevel ? new THREE.Vector3(0, 0, 1) : this.camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(normal, new THREE.Vector3(...position));
    return this.raycaster.ray.intersectPlane(plane, new THREE.Vector3())?.toArray() ?? null;
  }
}
