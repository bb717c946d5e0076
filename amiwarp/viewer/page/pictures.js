// Component with an image of the sensor: zoom, pan, draw a region, measure a distance. Linked images move together.

import { text as round } from './ticks.js';

const { computed, onBeforeUnmount, onMounted, reactive, ref, watch } = window.Vue;
const linked = {}; // zoom and place of linked images
const KEYS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const BLUE = '#56b4e9';
const YELLOW = '#f0e442';

const ARRAYS = { uint8: Uint8Array, uint16: Uint16Array, float32: Float32Array };

function numbers({ values, kind }) {
  return new ARRAYS[kind](values.slice().buffer);
}

// Return a canvas with a picture of the server: each value's place on its scale gives its colour.
export function painted(picture) {
  const { width, height, low, high, gamma, pair } = picture;
  const values = numbers(picture);
  const canvas = Object.assign(document.createElement('canvas'), { width, height });
  const image = new ImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  const known = new Map();
  const place = (value) => {
    if (!known.has(value)) known.set(value, Math.max(0, Math.min(1, (value - low) / (high - low))) ** gamma);
    return known.get(value);
  };
  const direct = (value) => Math.max(0, Math.min(1, (value - low) / (high - low)));
  const at = gamma === 1 ? direct : place;
  if (pair) {
    const n = width * height;
    for (let i = 0; i < n; i++) {
      const [off, on] = [at(values[i]), at(values[n + i])];
      const [r, g, b] = [0, 1, 2].map((k) => Math.round(255 * Math.min(1, off * pair[0][k] + on * pair[1][k])));
      pixels[i] = (0xff000000 | (b << 16) | (g << 8) | r) >>> 0;
    }
  } else {
    const table = new Uint32Array(picture.table.slice().buffer);
    for (let i = 0; i < pixels.length; i++) pixels[i] = Number.isNaN(values[i]) ? 0xff000000 : table[Math.floor(255 * at(values[i]))];
  }
  canvas.getContext('2d').putImageData(image, 0, 0);
  return canvas;
}

// Return the value of a picture at a pixel as text.
function valueAt(picture, x, y) {
  const values = numbers(picture);
  const { width, height, unit, pair, step } = picture;
  const [column, row] = [x, y].map((each) => Math.floor(each / step));
  if (column < 0 || row < 0 || column >= width || row >= height) return '';
  const k = row * width + column;
  if (pair) return `${values[k]} OFF, ${values[width * height + k]} ON`;
  return Number.isNaN(values[k]) ? 'no event' : `${round(values[k])} ${unit}`;
}

export const EventPicture = {
  props: { picture: Object, label: String, size: Array, crop: Array, frame: Array, link: String, tool: String },
  emits: ['region', 'at', 'measured'],
  template: `<canvas ref="canvas" class="picture" tabindex="0" role="img" :aria-label="text"></canvas>`,
  setup(props, { emit }) {
    const canvas = ref(null);
    let image = null;
    const view = (linked[props.link] ||= reactive({ zoom: 1, x: 0.5, y: 0.5 }));
    const text = computed(() => `${props.label}. Wheel or plus and minus to zoom, arrow keys to move, 0 for all.`);
    let drawn = null; // region or line that is being drawn [px of the sensor]
    let observer;

    const area = () => props.crop || [0, 0, ...props.size];
    const base = () => {
      const [left, top, right, bottom] = area();
      return Math.min(canvas.value.clientWidth / (right - left), canvas.value.clientHeight / (bottom - top));
    };
    const scale = () => base() * view.zoom;
    const centre = () => {
      const [left, top, right, bottom] = area();
      return [left + view.x * (right - left), top + view.y * (bottom - top)];
    };
    const seen = (x, y) => {
      const [cx, cy] = centre();
      return [canvas.value.clientWidth / 2 + (x - cx) * scale(), canvas.value.clientHeight / 2 + (y - cy) * scale()];
    };
    const place = (event) => {
      const box = canvas.value.getBoundingClientRect();
      const [cx, cy] = centre();
      return [
        cx + (event.clientX - box.left - box.width / 2) / scale(), cy + (event.clientY - box.top - box.height / 2) / scale(),
      ];
    };

    function draw() {
      const pad = canvas.value;
      if (!pad || !pad.clientWidth || !pad.clientHeight) return;
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      pad.width = Math.round(pad.clientWidth * ratio);
      pad.height = Math.round(pad.clientHeight * ratio);
      const context = pad.getContext('2d');
      context.scale(ratio, ratio);
      const [left, top, right, bottom] = area();
      context.imageSmoothingEnabled = scale() < 1;
      if (image) {
        const size = props.picture.step * scale(); // of the last row and column, a part may lie outside
        context.drawImage(image, ...seen(left, top), image.width * size, image.height * size);
      }
      if (props.frame) rectangle(context, props.frame, BLUE);
      if (drawn && props.tool === 'measure') measure(context, drawn);
      else if (drawn) rectangle(context, drawn, YELLOW);
      bar(context);
    }

    function rectangle(context, [left, top, right, bottom], colour) {
      const [a, b] = [seen(left, top), seen(right, bottom)];
      context.lineWidth = 2;
      context.strokeStyle = colour;
      context.strokeRect(a[0], a[1], b[0] - a[0], b[1] - a[1]);
    }

    function measure(context, [x0, y0, x1, y1]) {
      context.lineWidth = 2;
      context.strokeStyle = YELLOW;
      context.beginPath();
      context.moveTo(...seen(x0, y0));
      context.lineTo(...seen(x1, y1));
      context.stroke();
    }

    // Draw a bar of a round length [px of the sensor].
    function bar(context) {
      const most = (canvas.value.clientWidth * 0.3) / scale();
      const length = [1000, 500, 200, 100, 50, 20, 10, 5, 2, 1].find((each) => each <= most);
      if (!length) return;
      const [x, y] = [8, canvas.value.clientHeight - 8];
      context.font = '11px system-ui, sans-serif';
      context.fillStyle = 'rgba(0, 0, 0, 0.6)';
      context.fillRect(x - 4, y - 19, Math.max(length * scale(), 40) + 8, 23);
      context.fillStyle = '#ffffff';
      context.fillRect(x, y - 2, length * scale(), 3);
      context.fillText(`${length} px`, x, y - 7);
    }

    // Look at the place (x, y) [share of the area] as nearly as the picture stays filled with the image.
    function look(x, y) {
      const [left, top, right, bottom] = area();
      const within = (at, pixels, length) => {
        const half = Math.min(0.5, pixels / (2 * scale() * length));
        return Math.max(half, Math.min(1 - half, at));
      };
      view.x = within(x, canvas.value.clientWidth, right - left);
      view.y = within(y, canvas.value.clientHeight, bottom - top);
    }

    function zoom(factor, x = 0.5, y = 0.5) {
      const before = view.zoom;
      view.zoom = Math.max(1, Math.min(64, before * factor));
      const kept = before / view.zoom;
      look(x + (view.x - x) * kept, y + (view.y - y) * kept);
    }

    function share([x, y]) {
      const [left, top, right, bottom] = area();
      return [(x - left) / (right - left), (y - top) / (bottom - top)];
    }

    function pressed(event) {
      const first = place(event);
      const panning = event.button > 0 || event.shiftKey || !['region', 'measure'].includes(props.tool);
      canvas.value.setPointerCapture(event.pointerId);
      canvas.value.onpointermove = (now) => {
        const at = place(now);
        if (panning) {
          const [a, b] = [share(first), share(at)];
          look(view.x - (b[0] - a[0]), view.y - (b[1] - a[1]));
          return;
        }
        drawn = [...first, ...at];
        if (props.tool === 'measure') {
          const [dx, dy] = [at[0] - first[0], at[1] - first[1]];
          emit('measured', `${Math.hypot(dx, dy).toFixed(1)} px (${dx.toFixed(1)} right, ${dy.toFixed(1)} down)`);
        }
        draw();
      };
      canvas.value.onpointerup = canvas.value.onpointercancel = () => {
        canvas.value.onpointermove = hovered;
        canvas.value.onpointerup = canvas.value.onpointercancel = null;
        if (panning || props.tool === 'measure' || !drawn) return;
        const [xs, ys] = [[drawn[0], drawn[2]], [drawn[1], drawn[3]]].map((pair) => pair.sort((a, b) => a - b));
        const [width, height] = props.size;
        const box = [
          Math.max(0, Math.floor(xs[0])), Math.max(0, Math.floor(ys[0])), Math.min(width, Math.ceil(xs[1])),
          Math.min(height, Math.ceil(ys[1])),
        ];
        drawn = null;
        draw();
        if (box[2] - box[0] > 3 && box[3] - box[1] > 3) emit('region', box);
      };
    }

    function hovered(event) {
      const [x, y] = place(event).map(Math.floor);
      const inside = x >= 0 && y >= 0 && x < props.size[0] && y < props.size[1];
      const [left, top] = area();
      emit('at', inside ? `x ${x}, y ${y} px: ${props.picture ? valueAt(props.picture, x - left, y - top) : ''}` : '');
    }

    function paint() {
      image = props.picture ? painted(props.picture) : null;
      draw();
      canvas.value.dataset.images = Number(canvas.value.dataset.images || 0) + 1;
    }

    function typed(event) {
      const step = KEYS[event.key];
      if (event.key === '+') zoom(1.5, view.x, view.y);
      else if (event.key === '-') zoom(1 / 1.5, view.x, view.y);
      else if (event.key === '0') zoom(0);
      else if (step && view.zoom > 1) look(view.x - (0.1 * step[0]) / view.zoom, view.y - (0.1 * step[1]) / view.zoom);
      else return;
      event.preventDefault();
      event.stopPropagation();
    }

    onMounted(() => {
      observer = new window.ResizeObserver(() => window.requestAnimationFrame(draw));
      observer.observe(canvas.value);
      canvas.value.addEventListener('pointerdown', pressed);
      canvas.value.onpointermove = hovered;
      canvas.value.addEventListener('dblclick', () => zoom(0));
      canvas.value.addEventListener('contextmenu', (event) => event.preventDefault());
      canvas.value.addEventListener('keydown', typed);
      paint();
      canvas.value.addEventListener('wheel', (event) => {
        event.preventDefault();
        zoom(Math.exp(-0.0015 * event.deltaY), ...share(place(event)));
      }, { passive: false });
    });
    onBeforeUnmount(() => observer.disconnect());
    watch(() => props.picture, paint);
    watch(() => props.tool, () => {
      drawn = null;
      emit('measured', '');
      draw();
    });
    watch([() => props.frame, () => props.crop, () => props.size, view], draw);
    return { canvas, text };
  },
};
