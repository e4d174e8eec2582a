// The arrays that the page carries, unpacked and made into what three.js draws.

const byId = (id) => document.getElementById(id);
const scene = JSON.parse(byId("scene").textContent);

async function unpack(id, Type) {
  const holder = byId("buffer-" + id);
  if (!holder) return null;
  const text = atob(holder.textContent);
  holder.remove();
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Type(await new Response(stream).arrayBuffer());
}

function texture(rgb) {
  const rgba = new Uint8Array((rgb.length / 3) * 4).fill(255);
  for (let i = 0; i < rgb.length / 3; i++) rgba.set(rgb.subarray(3 * i, 3 * i + 3), 4 * i);
  const made = new THREE.DataTexture(rgba, rgb.length / 3, 1, THREE.RGBAFormat);
  made.magFilter = made.minFilter = THREE.LinearFilter;
  made.needsUpdate = true;
  return made;
}

async function surface(shared) {
  const geometry = new THREE.BufferGeometry();
  const positions = await unpack("positions", Float32Array);
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("shape", new THREE.BufferAttribute(await unpack("shape", Int16Array), 4, true));
  geometry.setIndex(new THREE.BufferAttribute(await unpack("faces", Uint32Array), 1));
  const colors = await unpack("colors", Uint8Array);
  const blank = new THREE.BufferAttribute(new Uint8Array(positions.length / 3 * 4), 4, true);
  geometry.setAttribute("tint", colors ? new THREE.BufferAttribute(colors, 4, true) : blank);
  const layers = {};
  for (const [index, layer] of scene.layers.entries()) {
    const values = await unpack("layer-" + index, Float32Array);
    const ramp = shared.ramps[layer.ramp] ??= texture(await unpack("ramp-" + layer.ramp, Uint8Array));
    layers[layer.name] = { ...layer, ramp, attribute: new THREE.BufferAttribute(values, 1) };
  }
  const none = new THREE.BufferAttribute(new Float32Array(positions.length / 3), 1);
  geometry.setAttribute("value", Object.values(layers)[0]?.attribute ?? none);
  const material = new THREE.ShaderMaterial({
    vertexShader: SURFACE_VERTEX, fragmentShader: SURFACE_FRAGMENT, side: THREE.DoubleSide,
    polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
    uniforms: {
      ...shared.uniforms, ramp: { value: null }, scale: { value: new THREE.Vector2(0, 1) }, paint: { value: 0 },
      beyond: { value: 3e38 },
      plain: { value: new THREE.Color() }, inner: { value: new THREE.Color() }, solid: { value: scene.solid },
    },
  });
  const lines = new THREE.ShaderMaterial({
    vertexShader: SURFACE_VERTEX, fragmentShader: LINE_FRAGMENT, wireframe: true, transparent: true, depthWrite: false,
    uniforms: { ...shared.uniforms, ink: { value: new THREE.Color() }, strength: { value: 0.3 } },
  });
  return { mesh: new THREE.Mesh(geometry, material), wire: new THREE.Mesh(geometry, lines), layers, colored: !!colors };
}

async function cloud(shared) {
  if (!scene.points) return null;
  const geometry = new THREE.BufferGeometry();
  const positions = await unpack("points", Float32Array);
  const normals = await unpack("point-normals", Int8Array);
  const colors = await unpack("point-colors", Uint8Array);
  const count = positions.length / 3;
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("direction", new THREE.BufferAttribute(normals ?? new Int8Array(4 * count), 4, true));
  geometry.setAttribute("tint", new THREE.BufferAttribute(colors ?? new Uint8Array(4 * count), 4, true));
  const material = new THREE.ShaderMaterial({
    vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT,
    uniforms: {
      ...shared.uniforms, plain: { value: new THREE.Color() }, directed: { value: !!normals }, tinted: { value: false },
      size: { value: Math.min(0.45 * scene.points.spacing, 0.02) }, focal: { value: 1 },
    },
  });
  return { points: new THREE.Points(geometry, material), colored: !!colors };
}
