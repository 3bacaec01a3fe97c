// Small helpers for building a page. Everything that comes from data goes in by textContent or as an attribute's value,
// never as markup, so that a file named `<script>` is shown as that text.

/**
 * Makes an element. `options`: `class`, `text`, `on` (event name to listener) and any other name as an attribute;
 * attributes that are null, undefined or false are left out.
 */
export function element(tag, options = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(options)) setOption(made, name, value);
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

function setOption(target, name, value) {
  if (value === null || value === undefined || value === false) return;
  if (name === "text") target.textContent = value;
  else if (name === "class") target.className = value;
  else if (name === "on") for (const [event, listener] of Object.entries(value)) target.addEventListener(event, listener);
  else target.setAttribute(name, value === true ? "" : String(value));
}

/** The page's data, from its JSON script element. */
export function pageData() {
  return JSON.parse(document.getElementById("data").textContent);
}

/** A number with a fixed count of decimals, or a dash where there is none. */
export function fixed(value, decimals) {
  return Number.isFinite(value) ? value.toFixed(decimals) : "–";
}

/** A count with thousands separated, the same in every locale. */
export function count(value) {
  return Number(value).toLocaleString("en-GB");
}

/** A length in metres with sensible digits: 0.021 m, 4.2 m, 35 m. */
export function metres(value) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0 m";
  return `${Number(value.toPrecision(value < 10 ? 2 : 3))} m`;
}

/** Text that may be long (a path): its middle is left out, the whole is in the tooltip and for screen readers. */
export function shortened(text, most = 90) {
  const whole = String(text);
  const characters = Array.from(whole);
  if (characters.length <= most) return element("span", { class: "wraps", text: whole });
  const half = Math.floor((most - 1) / 2);
  const short = `${characters.slice(0, half).join("")}…${characters.slice(-half).join("")}`;
  return element("span", { class: "wraps", text: short, title: whole, "aria-label": whole });
}

/** A button that copies `text` and says so for a moment. */
export function copyButton(label, text) {
  const button = element("button", { type: "button", class: "copy", text: label });
  const status = element("span", { class: "copied", role: "status" });
  button.addEventListener("click", async () => {
    const copied = await copyText(text);
    status.textContent = copied ? "Copied" : "Not copied: select the text and copy it by hand";
    setTimeout(() => { status.textContent = ""; }, 2500);
  });
  return element("span", { class: "copy-group" }, button, status);
}

async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return copyBySelection(text); // pages opened as files may lack the clipboard
  }
}

function copyBySelection(text) {
  const focused = document.activeElement;
  const area = element("textarea", { class: "offscreen", "aria-hidden": "true", readonly: true });
  area.value = text;
  document.body.append(area);
  area.select();
  const copied = document.execCommand("copy");
  area.remove();
  focused?.focus();
  return copied;
}

const themes = ["system", "light", "dark"];

/** Makes `button` step through the themes; `changed` is called after every change, also one of the system. */
export function bindThemeButton(button, changed = () => {}) {
  const root = document.documentElement;
  let current = 0;
  const show = () => {
    if (current === 0) delete root.dataset.theme;
    else root.dataset.theme = themes[current];
    button.textContent = `Theme: ${themes[current]}`;
    changed();
  };
  button.addEventListener("click", () => {
    current = (current + 1) % themes.length;
    show();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
  show();
}

/** A checkbox with its label; `swatch` is a CSS colour shown beside it. */
export function checkbox(label, checked, changed, options = {}) {
  const input = element("input", { type: "checkbox", checked, on: { change: () => changed(input.checked) } });
  const swatch = options.swatch ? element("i", { class: "swatch", style: `background:${options.swatch}` }) : null;
  const note = options.note ? element("span", { class: "muted", text: options.note }) : null;
  const root = element("label", { class: "check" }, input, swatch, element("span", { class: "wraps", text: label }), note);
  return { root, input };
}

/** A group of radio buttons drawn as one bar. `choices`: [value, label] pairs. */
export function choiceBar(legend, name, choices, chosen, changed) {
  const inputs = new Map();
  const bar = element("div", { class: "choice-bar" });
  for (const [value, label, tooltip] of choices) {
    const input = element("input", { type: "radio", name, value, checked: value === chosen, on: { change: () => changed(value) } });
    inputs.set(value, input);
    bar.append(element("label", { title: tooltip }, input, element("span", { text: label })));
  }
  const root = element("fieldset", {}, element("legend", { text: legend }), bar);
  return { root, choose: (value) => { inputs.get(value).checked = true; } };
}

/** A labelled slider. */
export function slider(label, { low, high, step, value, describe }, changed) {
  const input = element("input", { type: "range", min: low, max: high, step, value, "aria-label": label });
  const show = () => input.setAttribute("aria-valuetext", describe ? describe(input.valueAsNumber) : input.value);
  input.addEventListener("input", () => { show(); changed(input.valueAsNumber); });
  show();
  const root = element("label", { class: "slider" }, element("span", { text: label }), input);
  return { root, input, set: (to) => { input.valueAsNumber = to; show(); } };
}
