// What the drawings of the page share: numbers from the server, round numbers for axes, and canvases.

const { onBeforeUnmount, onMounted, ref } = window.Vue;

// Return the numbers in bytes from the server.
export function numbers(bytes, Kind = Float32Array) {
  return new Kind(bytes && bytes.byteLength ? bytes.slice().buffer : 0);
}

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

// Return a reference to a canvas that is drawn again when its size changes.
export function sizedCanvas(draw) {
  const canvas = ref(null);
  const observer = new window.ResizeObserver(() => window.requestAnimationFrame(() => canvas.value && draw()));
  onMounted(() => observer.observe(canvas.value));
  onBeforeUnmount(() => observer.disconnect());
  return canvas;
}

// Return the cleared context of a canvas, which draws in pixels of the page; null for a canvas without a size.
export function cleared(canvas) {
  if (!canvas || !canvas.clientWidth || !canvas.clientHeight) return null;
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight].map((each) => Math.round(each * ratio));
  const context = canvas.getContext('2d');
  context.scale(ratio, ratio);
  return context;
}

// Follow the pointer from the press of a button until its release.
export function drag(event, moved, released) {
  const canvas = event.currentTarget;
  canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = moved;
  canvas.onpointerup = canvas.onpointercancel = (end) => {
    canvas.onpointermove = canvas.onpointerup = canvas.onpointercancel = null;
    released(end);
  };
}

// Run the action of a key, if it has one, instead of what the page does with the key.
export function act(event, actions) {
  if (!Object.hasOwn(actions, event.key)) return;
  event.preventDefault();
  event.stopPropagation();
  actions[event.key]();
}
