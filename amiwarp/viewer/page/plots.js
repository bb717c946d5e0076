// Components with plots: the sharpness over a parameter, and the sharpness over two parameters as a map.

import { painted } from './pictures.js';
import { text, ticks } from './canvas.js';

const LEAST_SHARE = 0.18; // of a colour bar between two numbers
const WIDE_SHARE = 0.45; // of an axis between two wide numbers

const { computed } = window.Vue;

// Return the ticks of an axis with their places as shares of its length.
function placed(low, high, most) {
  return ticks(low, high, most).map((value) => ({ text: text(value), at: (value - low) / Math.max(high - low, 1e-12) }));
}

// Return the template of a plot with ticks and titles around its content.
const framed = (content, kind = '') => `<div class="plot ${kind}" role="img" :aria-label="label">
    <div class="plot-y">{{ yTitle }}</div>
    <div class="plot-box" @click="clicked">${content}
      <span v-for="t in up" class="tick-y" :style="{ bottom: 100 * t.at + '%' }">{{ t.text }}</span>
      <span v-for="t in across" class="tick-x" :style="{ left: 100 * t.at + '%' }">{{ t.text }}</span>
    </div>
    <div class="plot-x">{{ xTitle }}</div>
  </div>`;

export const CurvePlot = {
  props: { x: Array, y: Array, mark: Number, truth: Number, xTitle: String, yTitle: String, label: String },
  emits: ['pick'],
  template: framed(`
      <svg viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true">
        <line v-for="t in across" :x1="100 * t.at" :x2="100 * t.at" y1="0" y2="100" class="grid"/>
        <line v-for="t in up" x1="0" x2="100" :y1="100 - 100 * t.at" :y2="100 - 100 * t.at" class="grid"/>
        <line v-if="shown(truth)" class="truth" :x1="share(truth)" :x2="share(truth)" y1="0" y2="100"/>
        <line v-if="shown(mark)" class="mark" :x1="share(mark)" :x2="share(mark)" y1="0" y2="100"/>
        <polyline :points="points"/>
      </svg>`),
  setup(props, { emit }) {
    const range = computed(() => [props.x[0], props.x.at(-1)]);
    const tall = computed(() => {
      const [low, high] = [Math.min(...props.y), Math.max(...props.y)];
      const gap = 0.08 * (high - low) || 0.01;
      return [low - gap, high + gap];
    });
    const share = (value, [low, high] = range.value) => (100 * (value - low)) / (high - low);
    const shown = (value) => Number.isFinite(value) && Math.abs(share(value) - 50) <= 50.1; // nothing is moved to the end
    const points = computed(() => props.x.map((x, k) => `${share(x)},${100 - share(props.y[k], tall.value)}`).join(' '));
    const across = computed(() => { // wide numbers would touch each other
      const all = placed(...range.value, window.innerHeight > 520 ? 5 : 3);
      if (!all.some((tick) => tick.text.length > 4)) return all;
      const far = (tick, last) => !last || tick.at - last.at >= WIDE_SHARE;
      return placed(...range.value, 2).reduce((kept, tick) => (far(tick, kept.at(-1)) ? [...kept, tick] : kept), []);
    });
    const up = computed(() => placed(...tall.value, 4));
    function clicked(event) {
      const box = event.currentTarget.getBoundingClientRect();
      const at = (event.clientX - box.left) / box.width;
      emit('pick', range.value[0] + at * (range.value[1] - range.value[0]));
    }
    return { share, shown, points, across, up, clicked };
  },
};

export const CostSurface = {
  props: { x: Array, y: Array, picture: Object, marks: Array, xTitle: String, yTitle: String, label: String },
  template: framed(`<img :src="image" alt=""/>
      <span v-for="m in within" class="cross" :style="{ left: 100 * m.left + '%', bottom: 100 * m.bottom + '%' }"
        :title="m.title">{{ m.sign }}</span>`, 'surface'),
  setup(props) {
    const share = (value, axis) => (value - axis[0]) / (axis.at(-1) - axis[0]);
    const image = computed(() => painted(props.picture).toDataURL());
    const within = computed(() => props.marks.map((mark) => ({ ...mark, left: share(mark.x, props.x), bottom: share(mark.y, props.y) }))
      .filter(({ left, bottom }) => Math.min(left, bottom) >= 0 && Math.max(left, bottom) <= 1));
    const [across, up] = ['x', 'y'].map((name) => computed(() => placed(props[name][0], props[name].at(-1), 4)));
    return { image, within, across, up, clicked() {} };
  },
};

export const ColourBar = {
  props: { scale: Object },
  template: `<small class="colour-bar" v-if="!scale.square"><span class="bar" :style="{ background: scale.bar }"></span>
    <span v-for="t in apart" class="mark" :style="{ left: 100 * t[0] + '%', transform: 'translateX(' + -100 * t[0] + '%)' }">{{ t[1] }}</span><span class="title" :title="scale.title">{{ scale.title }}</span></small>
    <small class="colour-square" v-else><img :src="square" alt=""/><span>{{ scale.title }}<br/>right: OFF, 0 to {{ last }}<br/>up: ON, 0 to {{ last }}</span></small>`,
  setup(props) {
    const close = ([at], [before] = [-1]) => at - before < LEAST_SHARE;
    const apart = computed(() => props.scale.ticks.reduce((kept, tick) => (close(tick, kept.at(-1)) ? kept : [...kept, tick]), []));
    const square = computed(() => props.scale.square && painted(props.scale.square).toDataURL());
    const last = computed(() => props.scale.square && props.scale.square.high);
    return { apart, square, last };
  },
};
