// How surfaces, triangles and points are drawn. The files of this program are put into the page in the order of
// `PROGRAM` in write.py, and share one scope.
"use strict";

const LIGHT = `
  // The lamps of the preview picture: a key and a fill lamp and a sky, all fixed to the camera; colours are linear.
  vec3 lit(vec3 normal, vec3 color, float sky) {
    float share = sky * sky;
    vec3 light = mix(vec3(0.20, 0.17, 0.15), vec3(0.46, 0.52, 0.62), (normal.y + 1.0) / 2.0) * share;
    vec3 key = normalize(vec3(-0.65, 0.70, 0.45));
    float facing = clamp((dot(normal, key) + 0.15) / 1.15, 0.0, 1.0);
    float filling = clamp((dot(normal, normalize(vec3(0.85, 0.10, 0.35))) + 0.15) / 1.15, 0.0, 1.0);
    light += (1.45 * facing + 0.28 * filling) * (0.35 + 0.65 * share);
    float gloss = pow(clamp(dot(normal, normalize(key + vec3(0.0, 0.0, 1.0))), 0.0, 1.0), 40.0);
    return color * light / 1.5 + 0.06 * gloss * share;
  }
  vec3 linear(vec3 color) { return pow(color, vec3(2.2)); }
  vec4 encoded(vec3 light) { return vec4(pow(clamp(light, 0.0, 1.0), vec3(1.0 / 2.2)), 1.0); }
`;

const SURFACE_VERTEX = `
  attribute vec4 shape;
  attribute float value;
  attribute vec3 tint;
  varying vec3 vNormal, vPlace, vTint, vSeen;
  varying float vSky, vValue;
  void main() {
    vPlace = position;
    vSeen = (modelViewMatrix * vec4(position, 1.0)).xyz;
    vNormal = normalMatrix * shape.xyz;
    vSky = shape.w;
    vValue = value;
    vTint = tint;
    gl_Position = projectionMatrix * vec4(vSeen, 1.0);
  }
`;

const SURFACE_FRAGMENT = `
  uniform sampler2D ramp;
  uniform vec2 scale;
  uniform vec3 plain, inner;
  uniform vec4 section;
  uniform int paint;
  uniform float beyond;
  uniform bool solid;
  uniform float pixel;
  varying vec3 vNormal, vPlace, vTint, vSeen;
  varying float vSky, vValue;
  ${LIGHT}
  void main() {
    if (dot(vPlace, section.xyz) > section.w) discard;
    vec3 normal = normalize(vNormal);
    // The side of a needle is rounded to chance, so that the normal decides where it is clear.
    bool front = dot(normal, normalize(-vSeen)) > (gl_FrontFacing ? -0.3 : 0.3);
    if (!front && solid) {
      // The first thing seen through a section of a solid is its inside: hatched, as draughtsmen do.
      float stripe = abs(mod(gl_FragCoord.x + gl_FragCoord.y, 9.0 * pixel) - 4.5 * pixel) / pixel;
      gl_FragColor = vec4(inner * mix(1.0, 0.86, smoothstep(3.2, 4.2, stripe)), 1.0);
      return;
    }
    vec3 color = linear(plain);
    if (paint == 1 && vValue > -1e38)
      color = linear(texture2D(ramp, vec2(clamp((vValue - scale.x) / (scale.y - scale.x), 0.002, 0.998), 0.5)).rgb);
    if (paint == 1 && vValue <= -1e38) color = vec3(0.35);
    if (paint == 2) color = linear(vTint);
    vec3 light = lit(front ? normal : -normal, color, vSky);
    // Where colour is a measure, light only hints at the form.
    if (paint == 1) light = mix(light, color, 0.45);
    if (paint == 1 && vValue > beyond) {
      float stripe = abs(mod(gl_FragCoord.x - gl_FragCoord.y, 8.0 * pixel) - 4.0 * pixel) / pixel;
      light *= mix(0.45, 1.0, smoothstep(0.8, 1.8, stripe));
    }
    gl_FragColor = encoded(light);
  }
`;

const LINE_FRAGMENT = `
  uniform vec3 ink;
  uniform vec4 section;
  uniform float strength;
  varying vec3 vNormal, vPlace, vTint;
  varying float vSky, vValue;
  void main() {
    if (dot(vPlace, section.xyz) > section.w) discard;
    gl_FragColor = vec4(ink, strength);
  }
`;

const POINT_VERTEX = `
  attribute vec4 direction;
  attribute vec3 tint;
  uniform float size, focal;
  uniform bool directed;
  varying vec3 vNormal, vPlace, vTint;
  varying float vFacing;
  void main() {
    vPlace = position;
    vTint = tint;
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    vNormal = normalMatrix * direction.xyz;
    vFacing = directed ? dot(vNormal, -seen.xyz) : 1.0;
    // Drawn a little in front, so that points on the surface are not half within it.
    seen.z += 0.5 * size;
    gl_Position = projectionMatrix * seen;
    gl_PointSize = max(2.0 * size * focal / -seen.z, 2.0);
  }
`;

const POINT_FRAGMENT = `
  uniform vec3 plain;
  uniform vec4 section;
  uniform bool directed, tinted;
  varying vec3 vNormal, vPlace, vTint;
  varying float vFacing;
  ${LIGHT}
  void main() {
    vec2 off = 2.0 * gl_PointCoord - 1.0;
    if (dot(off, off) > 1.0 || dot(vPlace, section.xyz) > section.w || vFacing < 0.0) discard;
    vec3 ball = vec3(off.x, -off.y, sqrt(1.0 - dot(off, off)));
    vec3 color = linear(tinted ? vTint : plain);
    gl_FragColor = encoded(lit(normalize(directed ? ball + normalize(vNormal) : ball), color, 1.0));
  }
`;
