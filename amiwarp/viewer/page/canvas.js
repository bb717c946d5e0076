// What the components that draw on a canvas share: size, drags and keys.

const { onBeforeUnmount, onMounted, ref } = window.Vue;

// Return a reference to a canvas that is drawn again when its size changes.
export function sizedCanvas(draw) {
  const canvas = ref(null);
  const observer = new window.ResizeObserver(() => window.requestAnimationFrame(() => canvas.value && draw()));
  onMounted(() => observer.observe(canvas.value));
  onBeforeUnmount(() => observer.disconnect());
  return canvas;
}

// Return the cleared context of a canvas, which draws in pixels of the page; null for a canvas without a size.
export function cleared(canvas) {
  if (!canvas || !canvas.clientWidth || !canvas.clientHeight) return null;
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight].map((each) => Math.round(each * ratio));
  const context = canvas.getContext('2d');
  context.scale(ratio, ratio);
  return context;
}

// Follow the pointer from the press of a button until its release.
export function drag(event, moved, released) {
  const canvas = event.currentTarget;
  canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = moved;
  canvas.onpointerup = canvas.onpointercancel = (end) => {
    canvas.onpointermove = canvas.onpointerup = canvas.onpointercancel = null;
    released(end);
  };
}

// Run the action of a key, if it has one, instead of what the page does with the key.
export function act(event, actions) {
  if (!Object.hasOwn(actions, event.key)) return;
  event.preventDefault();
  event.stopPropagation();
  actions[event.key]();
}
