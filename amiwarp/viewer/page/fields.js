// Component with a slider and a number field for one value.

export const KnobField = {
  props: { name: String, label: String, unit: String, value: Number, least: Number, most: Number, step: Number, truth: Number,
    note: String },
  emits: ['drag', 'release', 'typed', 'chosen'],
  template: `<div class="knob">
    <label :for="'slider-' + name">{{ label }} ({{ unit }})</label>
    <span class="note" v-if="note">{{ note }}</span>
    <div class="track">
      <input type="range" :id="'slider-' + name" :min="least" :max="most" :step="step" :value="value"
        @input="$emit('drag', Number($event.target.value))" @change="$emit('release')" @focus="$emit('chosen')"/>
      <i v-if="truth !== null && truth !== undefined" class="truth" :title="'known truth: ' + truth"
        :style="{ left: 'calc(8px + (100% - 16px) * ' + (truth - least) / (most - least) + ')' }"></i>
    </div>
    <input type="number" :id="'field-' + name" :aria-label="label + ', number'" :value="value" step="any"
      @change="$emit('typed', $event.target.value)"/>
  </div>`,
};
