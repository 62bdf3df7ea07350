// SPDX-License-Identifier: Apache-2.0
import { DataTexture, LinearFilter, RGBAFormat } from "three";

// Viridis (S. van der Walt and N. Smith, CC0), at equal steps: even to the eye, and told apart by
// people who do not see red and green.
const STOPS = [
  "440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725",
];

/** Colours of a range of values, from low to high, as a texture of 256 by 1. */
export function rampTexture(): DataTexture {
  const data = new Uint8Array(4 * 256);
  for (let i = 0; i < 256; i++) {
    const place = (i / 255) * (STOPS.length - 1);
    const left = Math.min(Math.floor(place), STOPS.length - 2);
    const [a, b] = [channels(STOPS[left]), channels(STOPS[left + 1])];
    a.forEach((value, c) => { data[4 * i + c] = value + (place - left) * (b[c] - value); });
    data[4 * i + 3] = 255;
  }
  const texture = new DataTexture(data, 256, 1, RGBAFormat);
  texture.minFilter = texture.magFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

function channels(hex: string): number[] {
  return [0, 2, 4].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
}
