// The picture: a camera around the model, drawn whenever something has changed.

// Azimuth and elevation in degrees.
const VIEWS = { iso: [-35, 22], front: [0, 0], right: [90, 0], top: [0, 89.9] };
const FIELD = 24;

const state = {
  mode: "plain", mesh: "1", points: "0", wire: "0", axis: "off", cut: "0.5", view: "iso", up: "z",
  ...Object.fromEntries(new URLSearchParams(location.hash.slice(1))),
};

function css(name) {
  return new THREE.Color().setStyle(getComputedStyle(document.documentElement).getPropertyValue(name).trim(), "");
}

// Three digits, and a power of ten where there would be many zeros.
function figure(number) {
  const size = Math.abs(number);
  const text = size && (size < 1e-3 || size >= 1e6) ? number.toExponential(2) : String(+number.toPrecision(3));
  return text.replace("-", "−");
}

function coordinate(number) {
  const digits = Math.max(0, Math.min(9, 4 - Math.floor(Math.log10(scene.radius))));
  return number.toFixed(digits).replace("-", "−");
}

class Viewer {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.scene = new THREE.Scene();
    this.model = new THREE.Group();
    this.scene.add(this.model);
    this.camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.enableZoom = false;
    this.controls.zoomToCursor = true;
    this.controls.minDistance = 0.05;
    this.controls.maxDistance = 40;
    this.controls.addEventListener("change", () => this.draw());
    this.shared = {
      ramps: {},
      uniforms: { section: { value: new THREE.Vector4(0, 0, 0, 1) }, pixel: { value: devicePixelRatio } },
    };
  }

  async load() {
    this.surface = await surface(this.shared);
    this.cloud = await cloud(this.shared);
    this.model.add(this.surface.mesh, this.surface.wire);
    if (this.cloud) this.model.add(this.cloud.points);
  }

  // Only what has changed is drawn, and at most once a frame.
  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      // Near and far follow the eye, so that depths stay fine from afar as well as from close by.
      const distance = this.camera.position.length();
      this.camera.near = Math.max(distance - 3, 1e-3);
      this.camera.far = distance + 3;
      this.camera.updateProjectionMatrix();
      this.renderer.render(this.scene, this.camera);
    });
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.shared.uniforms.pixel.value = this.renderer.getPixelRatio();
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.cloud) {
      const tall = height * this.renderer.getPixelRatio();
      this.cloud.points.material.uniforms.focal.value = tall / 2 / Math.tan((FIELD / 360) * Math.PI);
    }
    if (!this.moved) this.look(state.view);
    this.draw();
  }

  // Sees the whole mesh as large as possible: each side of the picture is a plane that the outermost vertices touch.
  look(name) {
    const [azimuth, elevation] = (VIEWS[name] ?? VIEWS.iso).map((degrees) => (degrees * Math.PI) / 180);
    this.model.rotation.x = state.up === "z" ? -Math.PI / 2 : 0;
    this.model.updateMatrixWorld();
    const backward = new THREE.Vector3(
      Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation), Math.cos(azimuth) * Math.cos(elevation));
    const right = new THREE.Vector3(Math.cos(azimuth), 0, -Math.sin(azimuth));
    const upward = new THREE.Vector3().crossVectors(backward, right);
    const slope = 0.9 * Math.tan((FIELD / 360) * Math.PI);
    const sides = [[right, slope * this.camera.aspect], [upward, slope]];
    const reach = sides.map(() => [-Infinity, -Infinity]);
    const places = this.surface.mesh.geometry.attributes.position;
    const place = new THREE.Vector3();
    for (let i = 0; i < places.count; i += Math.ceil(places.count / 20000)) {
      place.fromBufferAttribute(places, i).applyMatrix4(this.model.matrixWorld);
      sides.forEach(([axis, s], k) => {
        const across = place.dot(axis) / s, depth = place.dot(backward);
        reach[k][0] = Math.max(reach[k][0], across + depth);
        reach[k][1] = Math.max(reach[k][1], depth - across);
      });
    }
    const distance = Math.max(...reach.map(([high, low]) => (high + low) / 2));
    const target = new THREE.Vector3();
    sides.forEach(([axis, s], k) => target.addScaledVector(axis, (s * (reach[k][0] - reach[k][1])) / 2));
    this.controls.target.copy(target);
    this.camera.position.copy(target).addScaledVector(backward, distance);
    this.controls.update();
    this.moved = false;
    this.draw();
  }

  theme() {
    const { mesh, wire } = this.surface;
    mesh.material.uniforms.plain.value = css("--clay");
    mesh.material.uniforms.inner.value = css("--inner");
    wire.material.uniforms.ink.value = css("--wire");
    if (this.cloud) this.cloud.points.material.uniforms.plain.value = css("--point");
    this.draw();
  }

  // Brings the picture into the state's likeness.
  show() {
    const { mesh, wire, layers, colored } = this.surface;
    const uniforms = mesh.material.uniforms, layer = layers[state.mode];
    uniforms.paint.value = layer ? 1 : state.mode === "colors" && colored ? 2 : 0;
    if (layer) {
      mesh.geometry.setAttribute("value", layer.attribute);
      uniforms.ramp.value = layer.ramp;
      uniforms.scale.value.set(layer.low, layer.high);
      uniforms.beyond.value = layer.beyond ?? 3e38;
    }
    mesh.visible = state.mesh === "1";
    wire.visible = state.wire === "1";
    wire.material.uniforms.strength.value = mesh.visible ? 0.3 : 0.5;
    if (this.cloud) {
      this.cloud.points.visible = state.points === "1";
      this.cloud.points.material.uniforms.tinted.value = state.mode === "colors" && this.cloud.colored;
    }
    const axis = "xyz".indexOf(state.axis), side = state.side === "1" ? 1 : -1;
    const place = axis < 0 ? 0 : scene.low[axis] + state.cut * (scene.high[axis] - scene.low[axis]);
    const normal = [0, 1, 2].map((k) => (k === axis ? side : 0));
    const height = axis < 0 ? 1 : (side * (place - scene.centre[axis])) / scene.radius;
    this.shared.uniforms.section.value.set(...normal, height);
    this.draw();
    return axis < 0 ? "" : `${state.axis} = ${coordinate(place)}`;
  }

  // The side of a section that is cut away: the one towards the eye.
  near(name) {
    const eye = this.model.worldToLocal(this.camera.position.clone());
    return name === "off" || eye.getComponent("xyz".indexOf(name)) > 0 ? "1" : "0";
  }

  // What lies under the pointer, in the file's coordinates.
  probe(event) {
    const box = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector2(
      (2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, this.camera);
    const { mesh, layers } = this.surface, section = this.shared.uniforms.section.value;
    for (const hit of mesh.visible ? ray.intersectObject(mesh) : []) {
      const local = this.model.worldToLocal(hit.point.clone());
      if (local.dot(new THREE.Vector3(section.x, section.y, section.z)) > section.w) continue;
      const place = local.toArray().map((value, k) => scene.centre[k] + scene.radius * value);
      const layer = layers[state.mode];
      let value = null;
      if (layer) {
        const ends = [hit.face.a, hit.face.b, hit.face.c].map((index) => layer.attribute.getX(index));
        value = hit.barycoord.x * ends[0] + hit.barycoord.y * ends[1] + hit.barycoord.z * ends[2];
      }
      return { world: hit.point, place, layer, value };
    }
    return null;
  }
}
