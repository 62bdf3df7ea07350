// SPDX-License-Identifier: Apache-2.0

const COUNT = new Intl.NumberFormat("en");

/** Write a whole number with separators: 32,000. */
export function count(value: number): string {
  return COUNT.format(Math.round(value));
}

/** Write a number with three digits that count: 0.0123. */
export function figure(value: number): string {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1000 || size < 1e-4 ? value.toPrecision(3) : String(Number(value.toPrecision(3)));
}

/** Write a number of bytes: 1.3 MB. */
export function bytes(value: number): string {
  const units = ["bytes", "kB", "MB", "GB"];
  const power = Math.min(3, Math.floor(Math.log10(Math.max(1, value)) / 3));
  const scaled = value / 1000 ** power;
  return `${scaled < 10 && power > 0 ? scaled.toFixed(1) : Math.round(scaled)} ${units[power]}`;
}

/** Write a time span: 4.2 s, 3 min 20 s. */
export function seconds(value: number): string {
  if (value < 9.95) return `${value.toFixed(1)} s`;
  if (value < 60) return `${Math.round(value)} s`;
  if (value < 3600) return `${Math.floor(value / 60)} min ${Math.round(value % 60)} s`;
  return `${Math.floor(value / 3600)} h ${Math.round((value % 3600) / 60)} min`;
}

/** Write how long ago a moment was: 5 min ago. */
export function ago(iso: string): string {
  const passed = (Date.now() - Date.parse(iso)) / 1000;
  if (passed < 60) return "just now";
  if (passed < 3600) return `${Math.floor(passed / 60)} min ago`;
  if (passed < 86_400) return `${Math.floor(passed / 3600)} h ago`;
  return `${Math.floor(passed / 86_400)} d ago`;
}
