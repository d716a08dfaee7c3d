// The private objects of viser's client: only this file uses them. `inner` is the window of the frame that it runs in, null or an
// error page of the browser where the scene failed to load.

const WORLD = "/world"; // the node whose axes are those of the map

function part(inner, name) {
  try {
    return inner?.[name];
  } catch {
    return undefined; // an error page, which has another origin
  }
}

const client = (inner) => part(inner, "__viserMutable") ?? {};

const nodeOf = (inner, name) => client(inner).nodeRefFromName?.[name] ?? null;

export const isBuilt = (inner) => Boolean(client(inner).scene && client(inner).nodeRefFromName);

// The camera, what moves it, the canvas and the root node with the axes of the map; null before all of them are there.
export function viewOf(inner) {
  const { camera, cameraControl: control, canvas } = client(inner), world = nodeOf(inner, WORLD);
  return camera && control && canvas && world ? { camera, control, canvas, world } : null;
}

export const controlOf = (inner) => client(inner).cameraControl ?? null;

// What viser was last sent of a node; null before that.
export const sentOf = (inner, name) => part(inner, "__viserSceneTree")?.getState()[name]?.message.props ?? null;

export const requestRender = (inner) => client(inner).requestRender?.();

// Calls act({ scene, renderer, camera, world }) before each picture in which the root node is there. The window of a frame is the
// same object after a reload, so an action of the same name is added once.
export function beforePicture(inner, name, act) {
  const { scene } = client(inner), then = scene.onBeforeRender;
  if (scene.userData[name]) return;
  scene.userData[name] = true;
  scene.onBeforeRender = (...args) => {
    then?.apply(scene, args);
    const world = nodeOf(inner, WORLD), [renderer, , camera] = args;
    if (world) act({ scene, renderer, camera, world });
  };
}

// viser's client draws a new pose of a node one picture before new content that arrived with it. What follows the robot is the
// pose of the world, and everything in it is content: so the world is drawn one picture later, with the content of its scan.
export function drawWorldWithItsContent(inner) {
  let node = null, set = null, drawn = null; // the last position set by viser, and the drawn one
  beforePicture(inner, "isInStep", ({ world }) => {
    if (world !== node) [node, set, drawn] = [world, world.position.clone(), world.position.clone()];
    const next = set;
    if (!world.position.equals(drawn)) set = world.position.clone();
    if (drawn.equals(next) && world.position.equals(drawn)) return;
    drawn = next;
    world.position.copy(drawn);
    world.updateMatrix();
    world.updateMatrixWorld(true);
  });
}

const POINT_PX = [1.5, 8]; // [px] smallest and largest diameter of a point

// viser draws a point by its size in metres only: near the camera it would be a disc, and far away it would vanish.
export function boundPointSizes(inner) {
  beforePicture(inner, "hasBounds", ({ scene, renderer }) => {
    const ends = POINT_PX.map((size) => (size * renderer.getPixelRatio()).toFixed(2)).join(", ");
    scene.traverse(({ isPoints, material }) => {
      if (!isPoints || material.userData.isBounded) return;
      material.userData.isBounded = true;
      material.vertexShader = material.vertexShader.replace("(scale / -world_pos.z)", `clamp(scale / -world_pos.z, ${ends})`);
      material.needsUpdate = true;
    });
  });
}

// Colours the instances of a node: colourOf(k, x, y) returns the colour [0 to 1] of instance k, which is at x, y; null for the
// colour that the server has sent.
export function colourInstances(inner, name, colourOf) {
  const sent = sentOf(inner, name);
  let mesh = null;
  nodeOf(inner, name)?.traverse((each) => { if (each.setColorAt) mesh ??= each; });
  if (!sent || !mesh) return false;
  const read = (Type, { buffer, byteOffset, byteLength }) => new Type(buffer.slice(byteOffset, byteOffset + byteLength));
  const at = read(Float32Array, sent.batched_positions), colours = read(Uint8Array, sent.batched_colors);
  const colour = mesh.material.color.clone();
  for (let k = 0; k < Math.min(at.length / 3, mesh.instancesCount); k += 1) {
    const own = colourOf(k, at[3 * k], at[3 * k + 1]), from = colours.length > 3 ? 3 * k : 0;
    if (own) colour.setRGB(...own);
    else colour.setRGB(colours[from] / 255, colours[from + 1] / 255, colours[from + 2] / 255);
    mesh.setColorAt(k, colour);
  }
  return true;
}

const LABEL_PX = 40; // of a screen that is 800 px high, per unit of a label 10 units away (LabelRenderer.tsx of viser)

// The labels before a camera as {place, near: distance from the camera, box: [left, bottom, right, top] in pixels, hide()}. The
// rectangles behind the texts are instances of one mesh, whose shader reads position and visibility of each label from a texture:
// [x, y, z, visible], written before each picture.
export function labelsIn(scene, camera) {
  const labels = [];
  scene.traverse(({ material, geometry }) => {
    const { uLabelData, uViewportHeight, uAtlas } = material?.uniforms ?? {};
    if (!uLabelData || uAtlas || !(geometry.instanceCount > 0)) return;
    const { aLabelIndex, aRect, aParams } = geometry.attributes, { data } = uLabelData.value.image;
    const height = uViewportHeight.value, width = height * camera.aspect;
    for (let k = 0; k < geometry.instanceCount; k += 1) {
      const at = 4 * aLabelIndex.getX(k);
      if (!data[at + 3]) continue;
      const place = camera.position.clone().set(data[at], data[at + 1], data[at + 2]);
      const near = place.distanceTo(camera.position), { x, y, z } = place.clone().project(camera);
      if (z > 1) continue; // behind the camera
      const unit = LABEL_PX * aParams.getY(k), left = ((x + 1) * width) / 2 + unit * aRect.getX(k), bottom = ((y + 1) * height) / 2 + unit * aRect.getY(k);
      const box = [left, bottom, left + unit * aRect.getZ(k), bottom + unit * aRect.getW(k)];
      labels.push({ place, near, box, hide: () => { data[at + 3] = 0; } });
    }
  });
  return labels;
}
