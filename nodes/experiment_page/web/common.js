// What all parts of the page use.

export const element = (id) => document.getElementById(id);
export const show = (id, visible) => { element(id).hidden = !visible; };

export function text(id, value) {
  const node = typeof id === "string" ? element(id) : id;
  if (node.textContent !== value) node.textContent = value;
}

/** A time as people say it. */
export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  const minutes = Math.floor(whole / 60);
  if (minutes < 60) return `${minutes} min ${String(whole % 60).padStart(2, "0")} s`;
  return `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

/** Make the children of a node those of the items, and keep those that did not change. Says whether any did. */
export function listOf(node, items, make) {
  const known = new Map([...node.children].map((child) => [child.dataset.item, child]));
  let changed = node.children.length !== items.length;
  const children = items.map((item, index) => {
    const key = JSON.stringify(item);
    const child = known.get(key);
    if (child) return child;
    changed = true;
    const made = make(item, index);
    made.dataset.item = key;
    return made;
  });
  if (changed) node.replaceChildren(...children);
  return changed;
}
