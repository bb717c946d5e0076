// Entry of the page's own code: registers the components, handles keys, the address and downloads.

import { EventClouds } from './clouds.js';
import { KnobField, NumberField } from './fields.js';
import { EventPicture } from './pictures.js';
import { ColourBar, CostSurface, CurvePlot } from './plots.js';
import { saveImages, savePicture } from './snapshot.js';
import { RateTimeline } from './timeline.js';

const { inject, onBeforeUnmount, onMounted, watch } = window.Vue;
const FIELDS = 'input:not([type=range]):not([type=checkbox]):not([type=radio]), textarea, select';
const LOOK = 'amiwarp-look';
const RETRY_MS = 1500;
const ASK_MS = 250; // interval between questions that the server answers at once, if it runs and is connected
const LATE_MS = 750; // age of an unanswered question from which the page is marked
const SAID_MS = 6000; // how long it is said that something was saved; errors stay
const ADDRESS_MS = 300; // a change of the address costs the browser more than a drawn cloud: once, after a drag

// Save a file of the server by its address, or a Blob of the page.
function download(name, content) {
  const link = document.createElement('a');
  link.href = content instanceof Blob ? URL.createObjectURL(content) : content;
  link.download = name;
  link.click();
  if (content instanceof Blob) setTimeout(() => URL.revokeObjectURL(link.href), 60e3);
}

// Element around the page: keys, the state in the address, downloads, and the loss of the connection.
const PageFrame = {
  props: { address: String, lost: String, look: Object, said: String },
  emits: ['late', 'forget'],
  template: `<div @click="released($event, 'button, summary, input[type=checkbox], input[type=radio]')"
    @change="released($event, 'select')"><slot/></div>`,
  setup(props, { emit }) {
    const trame = inject('trame');
    const gone = new AbortController(); // ends the page's own listeners
    let [retrying, changed, asking, saying] = [0, 0, 0, 0];
    let asked = 0; // time of the question that is not answered yet

    // Calls are answered in their order: an answer tells that the server has taken all changes before the question.
    function ask() {
      const now = performance.now();
      if (asked) {
        if (now - asked > LATE_MS) emit('late', Math.max(1, Math.round((now - asked) / 1000)));
        return;
      }
      asked = now;
      trame.trigger('answer').then(() => {
        asked = 0;
        emit('late', 0);
      }, () => {});
    }

    function pressed(event) {
      if (event.altKey || event.target.matches(FIELDS)) return;
      if (event.ctrlKey || event.metaKey) {
        const step = { z: event.shiftKey ? 'redo' : 'undo', y: 'redo' }[event.key.toLowerCase()];
        if (!step) return;
        event.preventDefault();
        trame.trigger(step);
        return;
      }
      if (event.target.matches('button, summary, a, input') && [' ', 'Enter'].includes(event.key)) return;
      if (event.target.matches('input') && event.key.startsWith('Arrow')) return;
      if (!trame.state.get('keys').some(([key]) => key === event.key)) return;
      event.preventDefault();
      trame.trigger('key', [event.key]);
    }

    // The browser keeps how the page looks, where a frame of another site lets it.
    function kept(look = null) {
      try {
        if (look) window.localStorage.setItem(LOOK, JSON.stringify(look));
        return JSON.parse(window.localStorage.getItem(LOOK)) || {};
      } catch {
        return {}; // no storage
      }
    }

    // After a click or a choice, the keys belong to the page again and not to the control.
    function released(event, controls) {
      if (event.type === 'change' || event.detail > 0) event.target.closest(controls)?.blur();
    }

    function restore() {
      const address = window.location.hash.slice(1);
      if (address && address !== props.address) trame.trigger('restore', [address]);
    }

    function retry() { // until the server is back
      fetch(window.location.pathname, { cache: 'no-store' }).then(({ ok }) => ok && window.location.reload(), () => {});
    }

    trame.refs.page = {
      download, picture: (name, words) => savePicture(name, words, trame.state, download),
      image: (name, words) => saveImages(name, words, trame.state, download),
    };
    watch(() => props.address, (address) => {
      window.clearTimeout(changed);
      if (address) changed = window.setTimeout(() => window.history.replaceState(null, '', `#${address}`), ADDRESS_MS);
    });
    watch(() => props.said, (said) => {
      window.clearTimeout(saying);
      if (said) saying = window.setTimeout(() => emit('forget'), SAID_MS);
    });
    watch(() => props.lost, (lost) => {
      window.clearInterval(retrying);
      if (lost) retrying = window.setInterval(retry, RETRY_MS);
    }, { immediate: true });
    onMounted(() => {
      asking = window.setInterval(ask, ASK_MS);
      window.addEventListener('keydown', pressed, gone);
      window.addEventListener('hashchange', restore, gone);
      restore();
      for (const [name, value] of Object.entries(kept())) {
        if (name in props.look && value !== props.look[name]) trame.state.set(name, value);
      }
      watch(() => JSON.stringify(props.look), () => kept(props.look));
    });
    onBeforeUnmount(() => {
      gone.abort();
      [retrying, asking, changed, saying].forEach((timer) => window.clearTimeout(timer));
    });
    return { released };
  },
};

// Dialog that has the focus while it exists. It closes by its button, by Escape, or by a click outside.
const PageDialog = {
  props: { title: String, name: String },
  emits: ['close'],
  template: `<dialog @vue:mounted="({ el }) => el.showModal()" @vue:before-unmount="({ el }) => el.close()" :id="name"
    :aria-label="title" @close="$emit('close')" @click.self="$emit('close')">
    <header><h2>{{ title }}</h2><button type="button" :id="name + '-close'" @click="$emit('close')">close</button></header>
    <slot/></dialog>`,
};

// Button that copies a text. Where a frame of another site has no clipboard, the text is selected in a dialog instead.
const CopyButton = {
  props: { text: String },
  template: `<button type="button" @click="copy">{{ done || 'copy' }}</button>`,
  data: () => ({ done: '' }),
  methods: {
    copy() {
      const say = (done) => {
        this.done = done;
        window.setTimeout(() => (this.done = ''), RETRY_MS);
      };
      const asked = navigator.clipboard ? navigator.clipboard.writeText(this.text) : Promise.reject();
      asked.then(() => say('copied'), () => window.prompt('Copy this text:', this.text));
    },
  },
};

const COMPONENTS = {
  CopyButton, EventClouds, EventPicture, RateTimeline, CurvePlot, CostSurface, ColourBar, KnobField, NumberField, PageFrame, PageDialog,
};
window.amiwarp_page = { install: (app) => Object.entries(COMPONENTS).forEach((each) => app.component(...each)) };
