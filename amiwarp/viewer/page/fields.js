// Components with a number field, and with a slider and a number field for one value.

const { onMounted, ref, watch } = window.Vue;

const KEPT_MS = 1500; // after it, a field shows the page's value again if the server took another one

// Field that shows a value of the page. While a number is being typed, updates of the page leave it alone. Enter leaves
// the field, Escape also forgets what was typed. A number outside its limits is refused, and the value of the page kept.
export const NumberField = {
  inheritAttrs: false,
  props: { value: [Number, String], low: { type: Number, default: -Infinity }, high: { type: Number, default: Infinity }, unit: { type: String, default: '' } },
  emits: ['typed'],
  template: `<span class="number"><input ref="box" type="number" step="any" v-bind="$attrs" :aria-invalid="!!wrong"
    @input="typed" @change="done" @blur="left" @keydown.enter="box.blur()" @keydown.esc="show(), box.blur()"/>
    <span v-if="wrong" class="wrong" role="alert">{{ wrong }}</span></span>`,
  setup(props, { emit }) {
    const box = ref(null);
    const wrong = ref('');
    let state = 'shown'; // or 'typing' or 'sent'
    let timer = 0;
    function show() {
      state = 'shown';
      if (box.value) box.value.value = props.value;
    }
    function typed() {
      state = 'typing';
      wrong.value = '';
    }
    function done() {
      const text = box.value.value;
      const value = Number(text);
      if (text !== '' && value >= props.low && value <= props.high) {
        state = 'sent';
        window.clearTimeout(timer);
        timer = window.setTimeout(() => state === 'sent' && show(), KEPT_MS);
        emit('typed', text);
        return;
      }
      const range = Number.isFinite(props.high) ? `${props.low} to ${props.high}` : 'a number';
      wrong.value = `${text === '' ? 'This' : text} is refused: give ${range}${props.unit && ` ${props.unit}`}. ${props.value} is kept.`;
      show();
    }
    function left() {
      if (state !== 'sent') show();
    }
    onMounted(show);
    watch(() => props.value, () => {
      if (state === 'typing') return;
      wrong.value = '';
      show();
    });
    return { box, wrong, show, typed, done, left };
  },
};

// While the slider is held, it shows where it is held, and not the value that comes back from the server.
export const KnobField = {
  components: { NumberField },
  props: { name: String, label: String, unit: String, value: Number, least: Number, most: Number, step: Number, truth: Number,
    note: String, low: Number, high: Number },
  emits: ['drag', 'typed', 'chosen'],
  template: `<div class="knob">
    <label :for="'slider-' + name">{{ label }} ({{ unit }})</label>
    <span class="note" v-if="note">{{ note }}</span>
    <div class="track">
      <input type="range" :id="'slider-' + name" :min="least" :max="most" :step="step" :value="held ?? value"
        @input="held = $event.target.valueAsNumber, $emit('drag', held)" @change="held = null, $emit('typed', $event.target.value)" @focus="$emit('chosen')"/>
      <i v-if="truth !== null && truth !== undefined" class="truth" :title="'known truth: ' + truth"
        :style="{ left: 'calc(8px + (100% - 16px) * ' + (truth - least) / (most - least) + ')' }"></i>
    </div>
    <NumberField :id="'field-' + name" :aria-label="label + ', number'" :value="held ?? value" :low="low" :high="high" :unit="unit"
      @typed="$emit('typed', $event)"/>
  </div>`,
  data: () => ({ held: null }),
};
