// Component with the rates of ON and OFF events over time: click or drag to move the window, wheel to zoom.

import { act, cleared, drag, numbers, short, sizedCanvas, text, ticks } from './canvas.js';

const { computed, watch } = window.Vue;
const GRIP_PX = 7; // distance within which an end of the window can be dragged
const LEFT = 62; // space for the ticks of the rate [px]
const BOTTOM = 17;
const MARGIN = 0.1; // share of the timeline before the window, after it went on

export const RateTimeline = {
  props: { on: null, off: null, span: Array, whole: Number, start: Number, length: Number, dark: Boolean, label: String, follow: Boolean },
  emits: ['move', 'resize', 'zoom', 'release'],
  template: `<canvas ref="canvas" class="timeline" tabindex="0" role="slider" :aria-label="label"
    aria-valuemin="0" :aria-valuemax="whole" :aria-valuenow="start" :aria-valuetext="text" @pointerdown="pressed"
    @dblclick="$emit('zoom', [0, whole])" @contextmenu.prevent @keydown="typed"
    @wheel.prevent="zoom(Math.exp(0.002 * $event.deltaY), time($event))"></canvas>`,
  setup(props, { emit }) {
    const canvas = sizedCanvas(draw);
    const text_ = computed(() => `window from ${text(props.start)} to ${text(props.start + props.length)} ms`);
    const width = () => Math.max(1, canvas.value.clientWidth - LEFT - 6);
    const seen = (ms) => LEFT + ((ms - props.span[0]) / (props.span[1] - props.span[0])) * width();
    const ends = () => [seen(props.start), seen(props.start + props.length)];
    const time = (event) => {
      const x = event.clientX - canvas.value.getBoundingClientRect().left - LEFT;
      return props.span[0] + (x / width()) * (props.span[1] - props.span[0]);
    };

    function draw() {
      const context = cleared(canvas.value);
      if (!context) return;
      const style = window.getComputedStyle(canvas.value);
      const colour = (name) => style.getPropertyValue(name).trim();
      const [W, H] = [width(), canvas.value.clientHeight - BOTTOM];
      const [on, off] = [numbers(props.on), numbers(props.off)];
      const top = Math.max(0, ...[...on, ...off].filter(Number.isFinite)); // parts that are not counted yet are NaN
      context.fillStyle = colour('--window');
      const left = Math.max(LEFT, ends()[0]);
      const right = Math.min(LEFT + W, Math.max(left + 2, ends()[1]));
      if (right > left) context.fillRect(left, 0, right - left, H);
      context.lineWidth = 1.4;
      for (const [rates, name] of [[on, '--on'], [off, '--off']]) {
        context.strokeStyle = colour(name);
        context.beginPath();
        rates.forEach((rate, k) => {
          const y = H - 2 - (rate / (top || 1)) * (H - 6);
          context.lineTo(LEFT + (k / rates.length) * W, y);
          context.lineTo(LEFT + ((k + 1) / rates.length) * W, y);
        });
        context.stroke();
      }
      context.fillStyle = colour('--accent');
      for (const edge of ends()) if (edge >= LEFT - 1 && edge <= LEFT + W + 1) context.fillRect(edge - 0.7, 0, 1.4, H);
      context.fillStyle = colour('--ink');
      axes(context, H, W, top);
    }

    function axes(context, H, W, top) {
      context.font = '11px system-ui, sans-serif';
      context.textAlign = 'right';
      const most = top > 0 ? short(top) : '';
      for (const [words, y, line] of [[most, 1, 'top'], ['events/s', H / 2, 'middle'], ['0', H + 3, 'bottom']]) {
        context.textBaseline = line;
        context.fillText(words, LEFT - 5, y);
      }
      context.textBaseline = 'top';
      const [unit, scale] = props.span[1] - props.span[0] > 2000 ? ['s', 1e-3] : ['ms', 1];
      ticks(props.span[0] * scale, props.span[1] * scale, W / 90).forEach((value, k, all) => {
        const x = seen(value / scale);
        context.fillRect(x, H, 1, 4);
        context.textAlign = x > LEFT + W - 20 ? 'right' : 'center';
        context.fillText(text(value) + (k === all.length - 1 ? ` ${unit}` : ''), Math.min(x, LEFT + W), H + 5);
      });
      context.fillRect(LEFT, H, W, 1);
    }

    function pressed(event) {
      const at = time(event);
      const x = seen(at);
      const [first, last] = ends();
      const near = [first, last].findIndex((end) => Math.abs(end - x) < GRIP_PX);
      const wide = last - first > 3 * GRIP_PX;
      const inside = x > first && x < last;
      const start = inside ? props.start : at - props.length / 2;
      const stop = props.start + props.length;
      if (!inside && near < 0) emit('move', start);
      drag(event, (now) => {
        const to = time(now);
        if (event.button > 0 || event.shiftKey) emit('zoom', [props.span[0] - (to - at), props.span[1] - (to - at)]);
        else if (wide && near === 0) emit('resize', [Math.min(to, stop - 1e-3), stop]);
        else if (wide && near === 1) emit('resize', [props.start, Math.max(to, props.start + 1e-3)]);
        else emit('move', start + to - at);
      }, () => emit('release'));
    }

    function zoom(factor, at) {
      const [low, high] = props.span;
      const length = Math.min((high - low) * factor, props.whole);
      const start = Math.max(0, Math.min(at - (at - low) * factor, props.whole - length));
      emit('zoom', [start, start + length]);
    }

    function typed(event) {
      const to = (start) => () => {
        emit('move', start);
        emit('release');
      };
      const by = (share) => to(props.start + share * props.length);
      const middle = props.start + props.length / 2;
      act(event, {
        ArrowLeft: by(-0.1), ArrowRight: by(0.1), PageDown: by(-1), PageUp: by(1), Home: to(0),
        End: to(props.whole - props.length), '+': () => zoom(0.5, middle), '-': () => zoom(2, middle),
      });
    }

    // While the recording is played, a zoomed timeline goes on when the window leaves it.
    function scroll() {
      const [low, high] = props.span;
      const length = high - low;
      const shown = Math.min(props.length, length);
      if (!props.follow || (props.start >= low - 1e-3 && props.start + shown <= high + 1e-3)) return;
      const start = Math.max(0, Math.min(props.start - Math.min(MARGIN * length, length - shown), props.whole - length));
      emit('zoom', [start, start + length]);
    }

    watch(() => [props.follow, props.start, props.length], scroll);
    watch(props, () => setTimeout(draw)); // then the page has the colours of dark mode
    return { canvas, text: text_, pressed, time, typed, zoom };
  },
};
