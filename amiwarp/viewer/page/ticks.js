// Round numbers for axes, and texts for them.

// Return round numbers from low to high, at most about `most` of them. Full turns are divided into equal parts.
export function ticks(low, high, most) {
  const span = high - low;
  if (!(span > 0) || most < 1) return [];
  const raw = span / most;
  const power = 10 ** Math.floor(Math.log10(raw));
  const turn = low === 0 && high === 360;
  const steps = turn ? [30, 45, 60, 90, 180, 360] : [1, 2, 2.5, 5, 10].map((step) => step * power);
  const step = steps.find((each) => each >= raw * 0.999) || steps[steps.length - 1];
  const out = [];
  for (let k = Math.ceil(low / step - 1e-6); k * step <= high + 1e-6 * span; k++) out.push(k * step);
  return out;
}

export function text(value) {
  return String(Number(value.toPrecision(6)));
}

// Return a number with an SI prefix, such as 1.2 M.
export function short(value) {
  const [size, prefix] = [[1e9, 'G'], [1e6, 'M'], [1e3, 'k']].find(([each]) => Math.abs(value) >= each) || [1, ''];
  return `${Number((value / size).toPrecision(3))} ${prefix}`.trimEnd();
}
