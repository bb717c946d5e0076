// Component with the rates of ON and OFF events over time: click or drag to move the window, wheel to zoom.

import { floats } from './clouds.js';
import { short, text, ticks } from './ticks.js';

const { computed, onBeforeUnmount, onMounted, ref, watch } = window.Vue;
const GRIP_PX = 7; // distance within which an end of the window can be dragged
const LEFT = 62; // space for the ticks of the rate [px]
const BOTTOM = 17;

export const RateTimeline = {
  props: { on: null, off: null, span: Array, whole: Number, start: Number, length: Number, dark: Boolean, label: String },
  emits: ['move', 'resize', 'zoom', 'release'],
  template: `<canvas ref="canvas" class="timeline" tabindex="0" role="slider" :aria-label="label"
    aria-valuemin="0" :aria-valuemax="whole" :aria-valuenow="start" :aria-valuetext="text"></canvas>`,
  setup(props, { emit }) {
    const canvas = ref(null);
    const text_ = computed(() => `window from ${text(props.start)} to ${text(props.start + props.length)} ms`);
    let observer;
    const width = () => Math.max(1, canvas.value.clientWidth - LEFT - 6);
    const seen = (ms) => LEFT + ((ms - props.span[0]) / (props.span[1] - props.span[0])) * width();
    const time = (event) => {
      const x = event.clientX - canvas.value.getBoundingClientRect().left - LEFT;
      return props.span[0] + (x / width()) * (props.span[1] - props.span[0]);
    };

    function draw() {
      const pad = canvas.value;
      if (!pad || !pad.clientWidth) return;
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      pad.width = Math.round(pad.clientWidth * ratio);
      pad.height = Math.round(pad.clientHeight * ratio);
      const context = pad.getContext('2d');
      context.scale(ratio, ratio);
      const style = window.getComputedStyle(pad);
      const colour = (name) => style.getPropertyValue(name).trim();
      const [W, H] = [width(), pad.clientHeight - BOTTOM];
      const [on, off] = [floats(props.on), floats(props.off)];
      const top = Math.max(0, ...[...on, ...off].filter(Number.isFinite)); // parts that are not counted yet are NaN
      context.fillStyle = colour('--window');
      const left = Math.max(LEFT, seen(props.start));
      const right = Math.min(LEFT + W, Math.max(left + 2, seen(props.start + props.length)));
      if (right > left) context.fillRect(left, 0, right - left, H);
      for (const [rates, name] of [[on, '--on'], [off, '--off']]) {
        context.strokeStyle = colour(name);
        context.lineWidth = 1.4;
        context.beginPath();
        rates.forEach((rate, k) => {
          const y = H - 2 - (rate / (top || 1)) * (H - 6);
          context.lineTo(LEFT + (k / rates.length) * W, y);
          context.lineTo(LEFT + ((k + 1) / rates.length) * W, y);
        });
        context.stroke();
      }
      context.strokeStyle = colour('--accent');
      for (const edge of [seen(props.start), seen(props.start + props.length)]) {
        if (edge < LEFT - 1 || edge > LEFT + W + 1) continue;
        context.beginPath();
        context.moveTo(edge, 0);
        context.lineTo(edge, H);
        context.stroke();
      }
      axes(context, colour('--ink'), H, W, top);
    }

    function axes(context, ink, H, W, top) {
      context.fillStyle = context.strokeStyle = ink;
      context.font = '11px system-ui, sans-serif';
      context.textAlign = 'right';
      context.textBaseline = 'top';
      if (top > 0) context.fillText(short(top), LEFT - 5, 1);
      context.textBaseline = 'bottom';
      context.fillText('0', LEFT - 5, H + 3);
      context.textBaseline = 'middle';
      context.fillText('events/s', LEFT - 5, H / 2);
      context.textBaseline = 'top';
      context.textAlign = 'center';
      const unit = props.span[1] - props.span[0] > 2000 ? ['s', 1e-3] : ['ms', 1];
      const values = ticks(props.span[0] * unit[1], props.span[1] * unit[1], W / 90);
      values.forEach((value, k) => {
        const x = seen(value / unit[1]);
        context.fillRect(x, H, 1, 4);
        const last = k === values.length - 1;
        const words = `${text(value)}${last ? ` ${unit[0]}` : ''}`;
        context.textAlign = x > LEFT + W - 20 ? 'right' : 'center';
        context.fillText(words, Math.min(x, LEFT + W), H + 5);
      });
      context.fillRect(LEFT, H, W, 1);
    }

    function pressed(event) {
      const at = time(event);
      const x = seen(at);
      const ends = [seen(props.start), seen(props.start + props.length)];
      const near = ends.findIndex((end) => Math.abs(end - x) < GRIP_PX);
      const wide = ends[1] - ends[0] > 3 * GRIP_PX;
      const inside = x > ends[0] && x < ends[1];
      const start = inside ? props.start : at - props.length / 2;
      const last = props.start + props.length;
      canvas.value.setPointerCapture(event.pointerId);
      const follow = (now) => {
        const to = time(now);
        if (event.button > 0 || event.shiftKey) emit('zoom', [props.span[0] - (to - at), props.span[1] - (to - at)]);
        else if (wide && near === 0) emit('resize', [Math.min(to, last - 1e-3), last]);
        else if (wide && near === 1) emit('resize', [props.start, Math.max(to, props.start + 1e-3)]);
        else emit('move', start + to - at);
      };
      if (!inside && near < 0) emit('move', start);
      canvas.value.onpointermove = follow;
      canvas.value.onpointerup = canvas.value.onpointercancel = () => {
        canvas.value.onpointermove = canvas.value.onpointerup = canvas.value.onpointercancel = null;
        emit('release');
      };
    }

    function zoom(factor, at) {
      const [low, high] = props.span;
      let [a, b] = [at - (at - low) * factor, at + (high - at) * factor];
      if (b - a >= props.whole) [a, b] = [0, props.whole];
      if (a < 0) [a, b] = [0, b - a];
      if (b > props.whole) [a, b] = [a - (b - props.whole), props.whole];
      emit('zoom', [Math.max(0, a), b]);
    }

    function typed(event) {
      const middle = props.start + props.length / 2;
      const by = { ArrowLeft: -0.1, ArrowRight: 0.1, PageDown: -1, PageUp: 1 }[event.key];
      if (by) emit('move', props.start + by * props.length);
      else if (event.key === 'Home') emit('move', 0);
      else if (event.key === 'End') emit('move', props.whole - props.length);
      else if (event.key === '+') zoom(0.5, middle);
      else if (event.key === '-') zoom(2, middle);
      else return;
      event.preventDefault();
      event.stopPropagation();
      emit('release');
    }

    onMounted(() => {
      observer = new window.ResizeObserver(() => window.requestAnimationFrame(draw));
      observer.observe(canvas.value);
      canvas.value.addEventListener('pointerdown', pressed);
      canvas.value.addEventListener('dblclick', () => emit('zoom', [0, props.whole]));
      canvas.value.addEventListener('contextmenu', (event) => event.preventDefault());
      canvas.value.addEventListener('keydown', typed);
      canvas.value.addEventListener('wheel', (event) => {
        event.preventDefault();
        zoom(Math.exp(0.002 * event.deltaY), time(event));
      }, { passive: false });
    });
    onBeforeUnmount(() => observer.disconnect());
    const content = ['on', 'off', 'span', 'start', 'length', 'whole'];
    watch(content.map((name) => () => props[name]), draw);
    watch(() => props.dark, () => setTimeout(draw));
    return { canvas, text: text_ };
  },
};
