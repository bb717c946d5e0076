// Component with an image of the sensor: zoom, pan, draw a region, measure a distance. Linked images move together.

import { act, cleared, drag, numbers, sizedCanvas, text as round } from './canvas.js';

const { computed, onMounted, reactive, watch } = window.Vue;
const linked = {}; // zoom and place of linked images
const BLUE = '#56b4e9';
const YELLOW = '#f0e442';
const ARRAYS = { uint8: Uint8Array, uint16: Uint16Array, float32: Float32Array };

const clamp = (value, low, high) => Math.max(low, Math.min(high, value));

// Return a canvas with a picture of the server: each value's place on its scale gives its colour.
export function painted(picture) {
  const { width, height, low, high, gamma, pair, missing } = picture;
  if (picture.rgba) return coloured(picture);
  const values = numbers(picture.values, ARRAYS[picture.kind]);
  const canvas = Object.assign(document.createElement('canvas'), { width, height });
  const image = new ImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  const known = new Map();
  const share = (value) => clamp((value - low) / (high - low), 0, 1);
  const at = gamma === 1 ? share : (value) => {
    if (!known.has(value)) known.set(value, share(value) ** gamma);
    return known.get(value);
  };
  const table = numbers(picture.table, Uint32Array);
  const unknown = (0xff000000 | (missing[2] << 16) | (missing[1] << 8) | missing[0]) >>> 0;
  for (let i = 0; i < pixels.length; i++) {
    if (pair) {
      const [off, on] = [at(values[i]), at(values[pixels.length + i])];
      const [r, g, b] = [0, 1, 2].map((k) => Math.round(255 * Math.min(1, off * pair[0][k] + on * pair[1][k])));
      pixels[i] = (0xff000000 | (b << 16) | (g << 8) | r) >>> 0;
    } else pixels[i] = Number.isNaN(values[i]) ? unknown : table[Math.floor(255 * at(values[i]))];
  }
  canvas.getContext('2d').putImageData(image, 0, 0);
  return canvas;
}

// Return a canvas with a picture whose pixels are colours.
function coloured({ width, height, rgba }) {
  const canvas = Object.assign(document.createElement('canvas'), { width, height });
  const image = new ImageData(width, height);
  image.data.set(numbers(rgba, Uint8Array));
  canvas.getContext('2d').putImageData(image, 0, 0);
  return canvas;
}

// Return the value of a picture at a pixel as text.
function valueAt(picture, x, y) {
  const { width, height, unit, pair, step } = picture;
  const [column, row] = [x, y].map((each) => Math.floor(each / step));
  if (column < 0 || row < 0 || column >= width || row >= height) return '';
  const k = row * width + column;
  if (picture.rgba) return numbers(picture.rgba, Uint8Array).slice(4 * k, 4 * k + 3).join(', ');
  const values = numbers(picture.values, ARRAYS[picture.kind]);
  if (pair) return `${values[k]} OFF, ${values[width * height + k]} ON`;
  return Number.isNaN(values[k]) ? picture.missing[3] : `${round(values[k])} ${unit}`;
}

export const EventPicture = {
  props: { picture: Object, label: String, size: Array, crop: Array, frame: Array, link: String, tool: String, mark: Array },
  emits: ['region', 'at', 'measured'],
  template: `<canvas ref="canvas" class="picture" tabindex="0" role="img" :aria-label="text" @pointerdown="pressed"
    @pointermove="hovered" @dblclick="zoom(0)" @contextmenu.prevent @keydown="typed" @wheel.prevent="wheeled"></canvas>`,
  setup(props, { emit }) {
    const canvas = sizedCanvas(draw);
    const view = (linked[props.link] ||= reactive({ zoom: 1, x: 0.5, y: 0.5 }));
    const text = computed(() => `${props.label}. Wheel or plus and minus to zoom, arrow keys to move, 0 for all.`);
    let image = null;
    let drawn = null; // region or line that is being drawn [px of the sensor]

    const area = () => {
      const [left, top, right, bottom] = props.crop || [0, 0, ...props.size];
      return { left, top, width: right - left, height: bottom - top };
    };
    const scale = () => {
      const { width, height } = area();
      return view.zoom * Math.min(canvas.value.clientWidth / width, canvas.value.clientHeight / height);
    };
    const centre = () => {
      const { left, top, width, height } = area();
      return [left + view.x * width, top + view.y * height];
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
      const context = cleared(canvas.value);
      if (!context) return;
      const { left, top } = area();
      context.imageSmoothingEnabled = scale() < 1;
      if (image) {
        const size = props.picture.step * scale(); // of the last row and column, a part may lie outside
        context.drawImage(image, ...seen(left, top), image.width * size, image.height * size);
      }
      if (props.mark) ring(context, ...seen(props.mark[0] + 0.5, props.mark[1] + 0.5));
      if (props.frame) outline(context, props.frame, BLUE);
      if (drawn) outline(context, drawn, YELLOW, props.tool === 'measure');
      bar(context);
    }

    // Draw a ring around a pixel, light on dark, so that it is seen on every image.
    function ring(context, x, y) {
      const radius = Math.max(9, scale());
      for (const [colour, wide] of [['#000000', 5], [YELLOW, 2.5]]) {
        context.lineWidth = wide;
        context.strokeStyle = colour;
        context.beginPath();
        context.arc(x, y, radius, 0, 2 * Math.PI);
        context.stroke();
      }
    }

    // Draw a rectangle between two places, or the line between them.
    function outline(context, [left, top, right, bottom], colour, asLine = false) {
      const [[x0, y0], [x1, y1]] = [seen(left, top), seen(right, bottom)];
      context.lineWidth = 2;
      context.strokeStyle = colour;
      context.beginPath();
      context.moveTo(x0, y0);
      if (asLine) context.lineTo(x1, y1);
      else context.rect(x0, y0, x1 - x0, y1 - y0);
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
      const half = (pixels, length) => Math.min(0.5, pixels / (2 * scale() * length));
      const [across, down] = [half(canvas.value.clientWidth, area().width), half(canvas.value.clientHeight, area().height)];
      Object.assign(view, { x: clamp(x, across, 1 - across), y: clamp(y, down, 1 - down) });
    }

    function zoom(factor, x = view.x, y = view.y) {
      const before = view.zoom;
      view.zoom = clamp(before * factor, 1, 64);
      const kept = before / view.zoom;
      look(x + (view.x - x) * kept, y + (view.y - y) * kept);
    }

    function wheeled(event) {
      const { left, top, width, height } = area();
      const [x, y] = place(event);
      zoom(Math.exp(-0.0015 * event.deltaY), (x - left) / width, (y - top) / height);
    }

    function pressed(event) {
      const first = place(event);
      const panning = event.button > 0 || event.shiftKey || !['region', 'measure'].includes(props.tool);
      drag(event, (now) => {
        const at = place(now);
        const [dx, dy] = [at[0] - first[0], at[1] - first[1]];
        if (panning) {
          look(view.x - dx / area().width, view.y - dy / area().height);
          return;
        }
        drawn = [...first, ...at];
        if (props.tool === 'measure') {
          emit('measured', `${Math.hypot(dx, dy).toFixed(1)} px (${dx.toFixed(1)} right, ${dy.toFixed(1)} down)`);
        }
        draw();
      }, () => {
        if (panning || props.tool === 'measure' || !drawn) return;
        const [xs, ys] = [[drawn[0], drawn[2]], [drawn[1], drawn[3]]].map((pair) => pair.sort((a, b) => a - b));
        const box = [Math.floor(xs[0]), Math.floor(ys[0]), Math.ceil(xs[1]), Math.ceil(ys[1])];
        const [left, top, right, bottom] = box.map((each, k) => clamp(each, 0, props.size[k % 2]));
        drawn = null;
        draw();
        if (right - left > 3 && bottom - top > 3) emit('region', [left, top, right, bottom]);
      });
    }

    function hovered(event) {
      if (event.buttons) return;
      const [x, y] = place(event).map(Math.floor);
      const inside = x >= 0 && y >= 0 && x < props.size[0] && y < props.size[1];
      const value = props.picture ? valueAt(props.picture, x - area().left, y - area().top) : '';
      emit('at', inside ? `x ${x}, y ${y} px: ${value}` : '');
    }

    function paint() {
      image = props.picture ? painted(props.picture) : null;
      draw();
      canvas.value.dataset.images = Number(canvas.value.dataset.images || 0) + 1;
    }

    function typed(event) {
      const by = (x, y) => () => look(view.x + (0.1 * x) / view.zoom, view.y + (0.1 * y) / view.zoom);
      act(event, {
        '+': () => zoom(1.5), '-': () => zoom(1 / 1.5), 0: () => zoom(0),
        ...(view.zoom > 1 && { ArrowLeft: by(-1, 0), ArrowRight: by(1, 0), ArrowUp: by(0, -1), ArrowDown: by(0, 1) }),
      });
    }

    onMounted(paint);
    watch(() => props.picture, paint);
    watch(() => props.tool, () => {
      drawn = null;
      emit('measured', '');
      draw();
    });
    watch([() => props.frame, () => props.crop, () => props.size, () => props.mark, view], draw);
    return { canvas, text, pressed, hovered, typed, wheeled, zoom };
  },
};
