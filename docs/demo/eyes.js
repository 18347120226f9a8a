// What the cameras of a scene see, drawn with three.js as like MuJoCo's own renderer as it can simply be.
import * as THREE from "./vendor/three.module.js";
import { geometryOf } from "./viewer.js";

const SAMPLES = 4; // of a pixel, and texels along a shadow, as in hgail_envs/vision/opengl.py
const SHADOW = 512;
const SEEN_GROUPS = 3; // geoms of further groups only collide
const SHARP = 0; // radius of a box's edges
const SKY = [0.83, 0.88, 0.935]; // the middle of its gradient; no camera of ours sees it
const BARE = { specular: 0.5, shininess: 0.5 }; // of a geom without a material
// three.js divides light by pi, where MuJoCo does not.
const FULL = Math.PI;

// Numbers of MJCF are colours as the screen shows them, and MuJoCo computes with them as they are.
const colourOf = (values) => new THREE.Color().setRGB(values[0], values[1], values[2], THREE.LinearSRGBColorSpace);

export class Eyes {
  constructor() {
    this.renderer = new THREE.WebGLRenderer({ powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.BasicShadowMap;
    this.camera = new THREE.PerspectiveCamera();
    this.camera.matrixAutoUpdate = false;
  }

  // Looks at another task's scene from cameras by their names, in pictures of `size` pixels along an edge.
  show(task, names, size) {
    this.#forget();
    this.task = task;
    this.size = size;
    this.cameras = names.map((name) => task.model.cam(name).id);
    this.target = new THREE.WebGLRenderTarget(size, size, { samples: SAMPLES });
    this.scene = new THREE.Scene();
    this.scene.background = colourOf(SKY);
    this.#light();
    this.meshes = [];
    for (let geom = 0; geom < task.model.ngeom; geom++) if (task.model.geom_group[geom] < SEEN_GROUPS) this.#add(geom);
  }

  #forget() {
    this.scene?.traverse((each) => {
      each.geometry?.dispose();
      each.material?.dispose();
    });
    this.lamp?.dispose();
    this.target?.dispose();
  }

  // The scene's one lamp, which casts shadows, and the light at each camera.
  #light() {
    const { model } = this.task, { headlight, map } = model.vis, half = map.shadowclip * model.stat.extent;
    this.lamp = new THREE.DirectionalLight(colourOf(model.light_diffuse), FULL);
    this.lamp.position.set(...model.light_pos.subarray(0, 3));
    this.lamp.target.position.copy(this.lamp.position).add(new THREE.Vector3(...model.light_dir.subarray(0, 3)));
    this.lamp.castShadow = true;
    const { shadow } = this.lamp;
    shadow.mapSize.setScalar(SHADOW);
    shadow.autoUpdate = false;
    Object.assign(shadow.camera, { left: -half, right: half, top: half, bottom: -half, near: 0.1, far: 10 });
    this.headlight = new THREE.DirectionalLight(colourOf(headlight.diffuse), FULL);
    this.scene.add(this.lamp, this.lamp.target, this.headlight, new THREE.AmbientLight(colourOf(headlight.ambient), FULL));
  }

  #add(geom) {
    const { model } = this.task, at = model.geom_matid[geom];
    const rgba = at < 0 ? model.geom_rgba.subarray(4 * geom) : model.mat_rgba.subarray(4 * at);
    const { specular, shininess } = at < 0 ? BARE : { specular: model.mat_specular[at], shininess: model.mat_shininess[at] };
    const exponent = 128 * shininess, gloss = specular * (model.light_specular[0] / model.light_diffuse[0]);
    const material = new THREE.MeshPhongMaterial({ color: colourOf(rgba), shininess: exponent });
    material.specular.setScalar(gloss / (0.25 * (0.5 * exponent + 1))); // undoes the factor of three.js
    const mesh = new THREE.Mesh(geometryOf(model, geom, SHARP), material);
    mesh.matrixAutoUpdate = false;
    mesh.castShadow = mesh.receiveShadow = true;
    mesh.userData.geom = geom;
    this.meshes.push(mesh);
    this.scene.add(mesh);
  }

  // Returns pictures of the present state, uint8 [cameras, size, size, 3]: the upper row first, red first.
  look() {
    const { data, model, mujoco } = this.task, { size } = this, pictures = new Uint8Array(this.cameras.length * size * size * 3);
    mujoco.mj_camlight(model, data);
    for (const mesh of this.meshes) placeAt(mesh, data.geom_xpos, data.geom_xmat, mesh.userData.geom);
    this.lamp.shadow.needsUpdate = true;
    this.cameras.forEach((id, index) => {
      placeAt(this.camera, data.cam_xpos, data.cam_xmat, id);
      this.headlight.position.setFromMatrixColumn(this.camera.matrix, 2); // from behind the camera, along its view
      Object.assign(this.camera, { fov: model.cam_fovy[id], near: 0.01, far: 50 });
      this.camera.updateProjectionMatrix();
      this.renderer.setRenderTarget(this.target);
      this.renderer.render(this.scene, this.camera);
      const drawn = new Uint8Array(4 * size * size);
      this.renderer.readRenderTargetPixels(this.target, 0, 0, size, size, drawn);
      turnOver(drawn, size, pictures.subarray(index * size * size * 3));
    });
    return pictures;
  }
}

export function placeAt(object, positions, rotations, index) {
  const [x, y, z] = positions.subarray(3 * index), m = rotations.subarray(9 * index);
  object.matrix.set(m[0], m[1], m[2], x, m[3], m[4], m[5], y, m[6], m[7], m[8], z, 0, 0, 0, 1);
  object.matrixWorldNeedsUpdate = true;
}

// Copies a picture as WebGL has it, the lower row first and with opacity, to one without.
function turnOver(drawn, size, picture) {
  for (let row = 0; row < size; row++)
    for (let column = 0; column < size; column++) {
      const from = 4 * ((size - 1 - row) * size + column), to = 3 * (row * size + column);
      picture.set(drawn.subarray(from, from + 3), to);
    }
}
