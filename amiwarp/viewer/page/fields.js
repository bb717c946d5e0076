// Components with a number field, and with a slider and a number field for one value.

const { onMounted, ref, watch } = window.Vue;

// Field that shows a value of the page. While a number is being typed, updates of the page leave it alone.
export const NumberField = {
  props: { value: [Number, String] },
  emits: ['typed'],
  template: '<input ref="box" type="number" step="any" @input="typing = true" @change="done" @blur="show"/>',
  setup(props, { emit }) {
    const box = ref(null);
    const typing = ref(false);
    function show() {
      typing.value = false;
      box.value.value = props.value;
    }
    function done() {
      typing.value = false;
      emit('typed', box.value.value);
    }
    onMounted(show);
    watch(() => props.value, () => typing.value || show());
    return { box, typing, done, show };
  },
};

// While the slider moves, its values are sent as the server takes them. The last one is sent as if it were typed, because
// calls to the server overtake values that wait.
export const KnobField = {
  components: { NumberField },
  props: { name: String, label: String, unit: String, value: Number, least: Number, most: Number, step: Number, truth: Number,
    note: String },
  emits: ['drag', 'typed', 'chosen'],
  template: `<div class="knob">
    <label :for="'slider-' + name">{{ label }} ({{ unit }})</label>
    <span class="note" v-if="note">{{ note }}</span>
    <div class="track">
      <input type="range" :id="'slider-' + name" :min="least" :max="most" :step="step" :value="value"
        @input="$emit('drag', Number($event.target.value))" @change="$emit('typed', $event.target.value)" @focus="$emit('chosen')"/>
      <i v-if="truth !== null && truth !== undefined" class="truth" :title="'known truth: ' + truth"
        :style="{ left: 'calc(8px + (100% - 16px) * ' + (truth - least) / (most - least) + ')' }"></i>
    </div>
    <NumberField :id="'field-' + name" :aria-label="label + ', number'" :value="value" @typed="$emit('typed', $event)"/>
  </div>`,
};
