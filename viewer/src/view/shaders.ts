// SPDX-License-Identifier: Apache-2.0

/** Colouring of points; the numbers are those of `uColor` below. */
export const COLORINGS = { normals: 0, rgb: 1, height: 2, value: 3 } as const;

export type Coloring = keyof typeof COLORINGS;

export const POINT_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform mat3 normalMatrix;
uniform int uColor;
uniform bool uHasNormals, uHasColors;
uniform float uDiameter, uPixels, uLeast;
uniform vec2 uRange, uDepth;
uniform vec3 uUp, uPlain;
uniform sampler2D uRamp;
in vec3 position, normal;
in vec4 color;
in float value;
out vec3 vColor;
flat out vec3 vNormal;
flat out float vRound;

void main() {
  vec4 eye = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * eye;
  float size = uDiameter * uPixels / max(-eye.z, 1e-6);
  gl_PointSize = clamp(size, uLeast, 48.0);
  vRound = gl_PointSize > 2.5 ? 1.0 : 0.0;

  vec3 n = uHasNormals ? normalize(normalMatrix * normal) : vec3(0.0, 0.0, 1.0);
  // The eye sees a surface from behind where its normal points away.
  float facing = uHasNormals ? -dot(n, normalize(eye.xyz)) : 1.0;
  vec3 lit = facing < 0.0 ? -n : n;
  // Not at once, for at silhouettes normals are across the line of sight.
  float behind = smoothstep(-0.12, -0.3, facing);
  vNormal = uHasNormals ? lit : vec3(0.0, 0.0, 1.0);
  float key = max(dot(lit, normalize(vec3(-0.35, 0.55, 0.75))), 0.0);
  float near = clamp((uDepth.y + eye.z) / (uDepth.y - uDepth.x), 0.0, 1.0);
  float light = uHasNormals
    ? 0.36 + 0.56 * key + 0.12 * max(lit.y, 0.0) + 0.22 * pow(key, 20.0)
    : 0.45 + 0.6 * near;

  vec3 base = uPlain;
  if (uColor == 1 && uHasColors) base = color.rgb;
  else if (uColor == 2 || uColor == 3) {
    float at = uColor == 2 ? dot(position, uUp) : value;
    float t = clamp((at - uRange.x) / max(uRange.y - uRange.x, 1e-12), 0.0, 1.0);
    base = texture(uRamp, vec2(mix(0.5 / 256.0, 255.5 / 256.0, t), 0.5)).rgb;
  } else if (uColor == 0 && uHasNormals) base = mix(base, vec3(0.93, 0.50, 0.22), behind);
  float strength = uColor == 0 ? 1.0 : 0.8;
  vColor = base * mix(1.0, light, strength);
}
`;

/** Points with a normal are discs that lie on the surface; others are discs that face the eye. */
export const POINT_FRAGMENT = /* glsl */ `
precision mediump float;
in vec3 vColor;
flat in vec3 vNormal;
flat in float vRound;
out vec4 fragment;

void main() {
  if (vRound > 0.5) {
    vec2 p = 2.0 * gl_PointCoord - 1.0;
    p.y = -p.y;
    // Thinner discs than this would leave gaps at silhouettes.
    float depth = dot(p, vNormal.xy) / max(vNormal.z, 0.35);
    if (dot(p, p) + depth * depth > 1.0) discard;
  }
  fragment = vec4(vColor, 1.0);
}
`;

/** Faces of a surface preview, with the light of the points. */
export const FACE_FRAGMENT = /* glsl */ `
precision mediump float;
in vec3 vColor;
flat in vec3 vNormal;
flat in float vRound;
out vec4 fragment;

void main() {
  fragment = vec4(vColor, 1.0);
}
`;

export const HAIR_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform float uLength;
in vec3 position, offset, normal;
out float vTip;

void main() {
  vTip = position.x;
  vec4 eye = modelViewMatrix * vec4(offset + normalize(normal) * position.x * uLength, 1.0);
  gl_Position = projectionMatrix * eye;
  gl_Position.z -= 1e-4 * gl_Position.w;
}
`;

export const HAIR_FRAGMENT = /* glsl */ `
precision mediump float;
uniform vec3 uHair;
in float vTip;
out vec4 fragment;

void main() {
  fragment = vec4(mix(uHair * 0.6, uHair, vTip), 1.0);
}
`;
