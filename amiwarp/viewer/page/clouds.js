// Component with the event clouds: draws the points in the browser, and lets the mouse and the keys turn them.

import { Camera, MARGIN, VIEWS, seenPart } from './camera.js';
import { act, drag, numbers, sizedCanvas } from './canvas.js';
import { drawFrame } from './frame.js';
import { GpuRaster } from './gpu.js';
import { Raster, nearest } from './raster.js';

const { computed, onMounted, ref, watch } = window.Vue;
const MOST_PIXELS = 3e6; // of the picture; a finer screen gets a coarser picture
const HEIGHT = 0.75; // length of the third axis as a share of the width of the region
const CLICK_PX = 3;
const REACH_PX = 8;
const GREY = 0xff909090;
const ORBIT = '#009e73';

export const EventClouds = {
  props: {
    before: null, after: null, third: null, thirdBefore: null, coloursBefore: null, coloursAfter: null, orbit: null, column: null,
    box: Array, axis: Object, titles: Array, view: Array, dot: Number, opacity: Number, overlaid: Boolean,
    dark: Boolean, picked: Number, slice: Array, beside: Boolean,
  },
  emits: ['pick', 'card', 'sliced', 'turned'],
  template: `<div class="clouds"><canvas ref="canvas" tabindex="0" role="img" :aria-label="label" @pointerdown="pressed"
    @contextmenu.prevent @keydown="typed" @wheel.prevent="wheeled"></canvas></div>`,
  setup(props, { emit }) {
    const extent = ref([1, 1]); // of the canvas [px of the page]
    const canvas = sizedCanvas(() => {
      extent.value = [canvas.value.clientWidth, canvas.value.clientHeight];
      draw();
    });
    const camera = new Camera(props.view[0]);
    const rasters = [0, 1].map(() => { // a graphics card draws the points if there is one
      try {
        return new GpuRaster();
      } catch {
        return new Raster();
      }
    });
    const drawn = [[], []]; // what the rasters show
    const shape = computed(() => { // as a text, because equal texts change nothing
      const [wide, tall] = [extent.value[0] - MARGIN.left - MARGIN.right, extent.value[1] - MARGIN.top - MARGIN.bottom];
      return JSON.stringify([props.box, props.axis, props.titles.length === 1 ? tall / Math.max(wide, 1) : 0]);
    });
    const frame = computed(() => frameOf(...JSON.parse(shape.value)));
    const places = [
      computed(() => place(frame.value, numbers(props.before), numbers(props.thirdBefore))),
      computed(() => place(frame.value, numbers(props.after), numbers(props.third))),
    ];
    const colours = ['coloursBefore', 'coloursAfter'].map((name) => computed(() => numbers(props[name], Uint32Array)));
    const lines = ['orbit', 'column'].map((name) => computed(() => {
      const [line, turns] = [name, 'orbit'].map((each) => numbers(props[each]));
      return place(frame.value, line.filter((_, k) => k % 3 !== 2), turns.filter((_, k) => k % 3 === 2));
    }));
    const label = computed(() => {
      const names = props.titles.map(([, title]) => title).join(' and ');
      return `Event cloud${props.titles.length > 1 ? 's' : ''}, ${names}, over x, y and ${props.axis.title}. `
        + 'Drag or shift and arrow keys to turn, wheel or plus and minus to zoom.';
    });
    const limits = computed(() => { // of the drawn slice of the third axis, in the box
      const [from, to] = props.slice;
      return [from > 0 ? from : -1e9, to < 1 ? to : 1e9].map((share) => frame.value.half[2] * (2 * share - 1));
    });
    const sliced = computed(() => { // how many events are in the slice; empty if it is everything
      if (props.slice[0] <= 0 && props.slice[1] >= 1) return '';
      const [points, [low, high]] = [places[1].value, limits.value];
      let count = 0;
      for (let k = 0; k < points.length; k += 3) {
        if (points[k + 2] >= low && points[k + 2] <= high && points[k] === points[k]) count++; // NaN: not drawn
      }
      return `${count.toLocaleString('en')} of these drawn (slice)`;
    });
    let waiting = false;
    let saved = 0; // pixels of the picture for each pixel of the page, while a picture is made that is to be saved

    function ask() {
      if (waiting) return;
      waiting = true;
      window.requestAnimationFrame(() => {
        waiting = false;
        if (canvas.value) draw();
      });
    }

    function panes() {
      const [W, H] = [canvas.value.clientWidth, canvas.value.clientHeight];
      const count = props.overlaid ? 1 : props.titles.length;
      const [across, down] = H > W ? [1, count] : [count, 1]; // on a phone, one cloud is below the other
      return Array.from({ length: count }, (_, k) => ({
        left: Math.round(((k % across) * W) / across), top: Math.round((Math.floor(k / across) * H) / down),
        width: Math.floor(W / across), height: Math.floor(H / down),
        clouds: props.overlaid && props.titles.length > 1 ? [0, 1] : [props.titles[k][0]],
        title: props.overlaid ? props.titles.map(([, title]) => title).join(' (grey), ') : props.titles[k][1],
      }));
    }

    // Return the projection of a pane, with the slice of the third axis that is drawn.
    function projected(pane) {
      const [low, high] = limits.value;
      return { ...camera.project(frame.value.half, pane.width, pane.height), low, high };
    }

    function draw() {
      const view = canvas.value;
      const [W, H] = [view.clientWidth, view.clientHeight];
      if (!W || !H || !props.titles.length) return;
      const ratio = saved || Math.min(window.devicePixelRatio || 1, Math.sqrt(MOST_PIXELS / (W * H)));
      const size = [Math.round(W * ratio), Math.round(H * ratio)];
      if (view.width !== size[0] || view.height !== size[1]) [view.width, view.height] = size;
      const style = window.getComputedStyle(view);
      const font = Math.round(0.92 * parseFloat(style.fontSize));
      const ink = style.getPropertyValue('--ink').trim() || '#333';
      const paper = style.getPropertyValue('--paper').trim() || '#ffffff';
      const context = view.getContext('2d');
      const dot = Math.max(1, Math.round(props.dot * ratio * Math.max(1, Math.min(2.5, H / 420))));
      panes().forEach((pane, number) => {
        const projection = projected(pane);
        if (rasters[number].lost) rasters[number] = new Raster();
        const raster = rasters[number];
        const key = JSON.stringify([projection, pane.width, pane.height, ratio, paper, dot, props.opacity, pane.clouds]);
        const content = [raster, key, ...pane.clouds.flatMap((k) => [places[k].value, colours[k].value])];
        if (content.some((each, k) => each !== drawn[number][k])) {
          drawn[number] = content;
          const fine = { ...projection, scale: projection.scale * ratio, x: projection.x * ratio, y: projection.y * ratio };
          raster.begin(Math.max(1, Math.round(pane.width * ratio)), Math.max(1, Math.round(pane.height * ratio)), packed(paper));
          const clip = clipOf(projection, pane).map((each) => Math.round(each * ratio));
          for (const k of pane.clouds) {
            const grey = pane.clouds.length > 1 && k === 0 ? GREY : 0;
            raster.points(places[k].value, colours[k].value, fine, dot, props.opacity, clip, grey);
          }
        }
        context.setTransform(1, 0, 0, 1, 0, 0);
        raster.show(context, Math.round(pane.left * ratio), Math.round(pane.top * ratio));
        context.setTransform(ratio, 0, 0, ratio, pane.left * ratio, pane.top * ratio);
        context.save();
        context.beginPath();
        context.rect(0, 0, pane.width, pane.height);
        context.clip();
        drawContent(context, projection, pane, [ink, paper], font);
        context.restore();
      });
      view.dataset.frames = Number(view.dataset.frames || 0) + 1;
    }

    // Return a canvas with what is seen, with more pixels than the screen has.
    function pictureAt(ratio) {
      saved = ratio;
      draw();
      const copy = Object.assign(document.createElement('canvas'), { width: canvas.value.width, height: canvas.value.height });
      copy.getContext('2d').drawImage(canvas.value, 0, 0);
      saved = 0;
      draw();
      return copy;
    }

    function drawContent(context, projection, pane, [ink, paper], size) {
      const [left, top, right, bottom] = props.box;
      const part = seenPart(frame.value.half, projection);
      const axes = [
        { low: left, high: right, title: 'x (px)' }, { low: bottom, high: top, title: 'y (px)' }, props.axis,
      ].map(({ low, high, title }, k) => {
        const at = (place) => low + ((place + frame.value.half[k]) / (2 * frame.value.half[k])) * (high - low);
        return { ends: part.map((corner) => at(corner[k])), title };
      });
      drawFrame(context, projection, part, axes, [ink, paper], size, [pane.width, pane.height]);
      context.strokeStyle = ORBIT;
      context.lineWidth = 2.5;
      context.save();
      context.beginPath();
      const [x0, y0, x1, y1] = clipOf(projection, pane);
      context.rect(x0, y0, x1 - x0, y1 - y0);
      context.clip();
      const at = (points, k) => projection.at(points.subarray(3 * k, 3 * k + 3)).slice(0, 2);
      for (const line of pane.clouds.map((k) => lines[k].value)) {
        context.beginPath();
        for (let k = 0; k < line.length / 3; k++) context.lineTo(...at(line, k));
        context.stroke();
      }
      context.restore();
      context.strokeStyle = ink;
      context.lineWidth = 2;
      for (const k of props.picked >= 0 ? pane.clouds.filter((cloud) => cloud || !props.beside) : []) {
        context.beginPath();
        context.arc(...at(places[k].value, props.picked), 7, 0, 2 * Math.PI);
        context.stroke();
      }
      context.fillStyle = ink;
      context.font = `600 ${size + 1}px system-ui, sans-serif`;
      context.textAlign = 'center';
      context.textBaseline = 'top';
      context.fillText(pane.title, pane.width / 2, 7);
    }

    // Return where points are drawn: below the title; in a view along an axis, within the frame, next to the ticks.
    function clipOf(projection, pane) {
      if (!projection.along) return [0, MARGIN.top - 4, pane.width, pane.height];
      const ends = seenPart(frame.value.half, projection).map((corner) => projection.at(corner));
      const [xs, ys] = [0, 1].map((k) => ends.map((end) => end[k]).sort((a, b) => a - b));
      return [xs[0] - 2, ys[0] - 2, xs[1] + 3, ys[1] + 3];
    }

    // Return the pane below the pointer, and the place in it [px].
    function under(event) {
      const box = canvas.value.getBoundingClientRect();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      const all = panes();
      const pane = all.find((each) => x < each.left + each.width && y < each.top + each.height) || all[0];
      return [pane, x - pane.left, y - pane.top];
    }

    function turn(x, y) {
      camera.turn(x, y);
      emit('turned', true);
    }

    function pressed(event) {
      const start = [event.clientX, event.clientY];
      let last = start;
      let moved = false;
      drag(event, (now) => {
        const by = [now.clientX - last[0], now.clientY - last[1]];
        moved = moved || Math.hypot(now.clientX - start[0], now.clientY - start[1]) > CLICK_PX;
        if (!moved) return;
        last = [now.clientX, now.clientY];
        if (event.button > 0 || event.shiftKey) camera.move(...by);
        else turn(...by);
        ask();
      }, (end) => {
        const [pane, x, y] = under(end);
        const cloud = pane.clouds.at(-1);
        if (moved || end.type !== 'pointerup' || (!cloud && props.beside)) return; // events of another recording
        emit('pick', nearest(places[cloud].value, projected(pane), x, y, REACH_PX));
      });
    }

    function wheeled(event) {
      const [pane, x, y] = under(event);
      camera.scale(Math.exp(-0.0015 * event.deltaY), x - pane.width / 2, y - pane.height / 2);
      ask();
    }

    function typed(event) {
      const by = (x, y) => () => turn(12 * x, 12 * y);
      act(event, {
        '+': () => camera.scale(1.25), '-': () => camera.scale(0.8),
        ...(event.shiftKey && { ArrowLeft: by(-1, 0), ArrowRight: by(1, 0), ArrowUp: by(0, -1), ArrowDown: by(0, 1) }),
      });
      ask();
    }

    onMounted(() => {
      canvas.value.pictureAt = pictureAt;
      emit('card', rasters[0] instanceof GpuRaster);
      ask();
    });
    watch(props, () => setTimeout(ask)); // then the page has the colours of dark mode
    watch(sliced, (text) => emit('sliced', text));
    watch(() => props.view, ([view]) => {
      camera.look(view);
      emit('turned', false);
      ask();
    });
    return { canvas, label, pressed, typed, wheeled };
  },
};

// Return half the size of the box around the points, its centre, and the stretch of the third axis. A single cloud is as
// tall as its pane is (`aspect`: height over width), seen from the corner.
function frameOf([left, top, right, bottom], { low, high }, aspect) {
  const [width, height] = [right - left, bottom - top];
  const side = Math.max(width, height);
  const [azimuth, elevation] = VIEWS.free;
  const [c, s] = [Math.abs(Math.cos(azimuth)), Math.abs(Math.sin(azimuth))];
  const fills = (aspect * (width * s + height * c) - Math.sin(elevation) * (width * c + height * s)) / Math.cos(elevation);
  const tall = aspect ? Math.max(0.4 * side, Math.min(1.6 * side, fills)) : HEIGHT * side;
  return {
    half: [(right - left) / 2, (bottom - top) / 2, tall / 2],
    centre: [(left + right) / 2, (top + bottom) / 2, (low + high) / 2],
    stretch: tall / Math.max(high - low, 1e-9),
  };
}

// Return places in the box (x, y, z interleaved) of pixels and values on the third axis.
function place({ centre, stretch }, xy, third) {
  const out = new Float32Array((3 * xy.length) / 2);
  const [cx, cy, cz] = centre;
  for (let i = 0, j = 0; i < third.length; i++, j += 3) {
    out[j] = xy[2 * i] - cx;
    out[j + 1] = cy - xy[2 * i + 1];
    out[j + 2] = (third[i] - cz) * stretch;
  }
  return out;
}

// Return a colour such as #15181c as a pixel of an image.
function packed(hex) {
  const value = parseInt(hex.slice(1), 16);
  return (0xff000000 | ((value & 0xff) << 16) | (value & 0xff00) | (value >>> 16)) >>> 0;
}
