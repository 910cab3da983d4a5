// The page: shows the state that the server has, and sends steps. What a person decides is decided on the server.
const TITLES = {
  cell: "Robot and cell", conventions: "Conventions", plan: "Plan", measure: "Measure",
  decide: "Decide", verify: "Verify", hand_over: "Hand over",
};
const MARKS = { passed: "✓ ", open: "", ahead: "… " };
const WORDS = { passed: "done", open: "to do", ahead: "waits for another gate" };
const IN_SPACE = ["plan", "measure"];
const LOST = "No answer from the robot's computer. What was taken is on its disk; this page goes on when it answers.";
let state = null, space = null, spaceOf = null, touch = null, sending = false, askedFor = null;

const $ = (id) => document.getElementById(id);

function el(tag, words, attributes = {}) {
  const made = document.createElement(tag);
  if (Array.isArray(words)) made.append(...words);
  else if (words !== undefined) made.textContent = words;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

async function ask(address, body) {
  const headers = { "Content-Type": "application/json" };
  const options = body === undefined ? {} : { method: "POST", headers, body: JSON.stringify(body) };
  const lost = () => { throw new Error(LOST); };
  const reply = await fetch(address, options).catch(lost), kind = reply.headers.get("Content-Type");
  if (kind !== "application/json") throw new Error((await reply.text().catch(lost)).trim());
  const found = await reply.json().catch(lost);
  if (!reply.ok) throw new Error(found.error);
  return found;
}

async function step(name, more = {}) {
  if (sending || state === null) return null;
  sending = true;
  try {
    const found = await ask("/step", { step: name, version: state.version, ...more });
    $("trouble").textContent = "";
    show(found.state);
    return found;
  } catch (error) {
    $("trouble").textContent = error.message;
    refresh();
    return null;
  } finally {
    sending = false;
  }
}

async function refresh() {
  try {
    show(await ask("/state"));
    if ($("trouble").textContent === LOST) $("trouble").textContent = "";
  } catch (error) {
    $("trouble").textContent = error.message;
  }
}

function gateShown() {
  const wanted = location.hash.slice(1);
  if (wanted in TITLES) return wanted;
  return Object.keys(TITLES).find((name) => state.gates[name].state === "open") || "hand_over";
}

function show(next) {
  if (state !== null && next.run === state.run && next.version < state.version) return;
  state = next;
  document.title = `casacal: ${state.name}`;
  $("name").textContent = `${state.name} · ${state.robot}`;
  $("busy").textContent = state.job === null ? "" : `${state.job} …`;
  $("spoilt").textContent = state.trouble;
  const shown = gateShown();
  $("gates").replaceChildren(...Object.keys(TITLES).map((name) => {
    const gate = state.gates[name].state;
    const link = el("a", MARKS[gate] + TITLES[name], { href: `#${name}` });
    link.setAttribute("aria-label", `${TITLES[name]}: ${WORDS[gate]}`);
    if (name === shown) link.setAttribute("aria-current", "step");
    return el("li", [link]);
  }));
  for (const name of Object.keys(TITLES)) {
    const section = $(name), gate = state.gates[name], said = section.querySelector(".said");
    section.hidden = name !== shown;
    section.querySelector(".missing").textContent = gate.missing ? `Missing: ${gate.missing}.`.replace("..", ".") : "";
    if (said) {
      said.replaceChildren(...gate.said.map((words) => el("li", words)));
      said.classList.toggle("failed", gate.failed);
    }
  }
  for (const button of document.querySelectorAll("main button")) button.disabled = state.job !== null;
  for (const [id, file] of [["sheet", "sheet.html"], ["report-link", "report.html"], ["verified", "verified.html"]]) {
    $(id).parentElement.hidden = !state.files.includes(file);
  }
  $("facts").replaceChildren(...state.gates.cell.facts.flatMap(([name, words]) => [el("dt", name), el("dd", words)]));
  showConventions(state.gates.conventions);
  showPlan(state.gates.plan);
  showMeasure(state.gates.measure);
  showDecision(state.gates.decide);
  showHandOver(state.gates.hand_over);
  showSpace(shown);
}

function showConventions(gate) {
  $("rows-joints").hidden = !state.gates.measure.controller;
  const turned = { quaternion: "qw qx qy qz", rxyz: "RX RY RZ (rad)", rxyz_deg: "RX RY RZ" }[$("form").value];
  $("order").textContent = `${state.joints.join(" ")} x y z ${turned || "three angles"}`;
}

function showPlan(gate) {
  $("planning").hidden = gate.fixed;
  $("plan-notes").replaceChildren(...gate.notes.map((words) => el("li", words)));
  $("planned").replaceChildren(...gate.touches.map((each) => {
    const look = el("button", "Show", { type: "button", "aria-label": `Show touch ${each.number}` });
    look.addEventListener("click", () => { touch = each.number; showSpace("plan"); $("view").scrollIntoView({ block: "nearest" }); });
    return el("tr", [el("td", each.number), el("td", each.where), el("td", each.purpose), el("td", [look])]);
  }));
  $("plan").querySelector(".scroll").hidden = gate.touches.length === 0;
}

function showMeasure(gate) {
  $("measuring").hidden = gate.state === "ahead";
  $("measure").querySelector(".missing").classList.toggle("underway", gate.state !== "ahead");
  if (gate.state === "ahead") return;
  const next = gate.next, waits = next !== null || gate.doubt !== null;
  const number = next === null ? "" : next.number === null ? "One more touch" : `Touch ${next.number} of ${gate.planned}`;
  $("where").textContent = next === null ? "" : [number, next.where, next.purpose].filter(Boolean).join(" · ");
  $("do-not").textContent = next === null ? "" : next.warning;
  showPosture(next);
  $("expected").textContent = next === null ? "" : `Expect ${next.expected || "a touch"}`;
  $("waiting").textContent = gate.waiting;
  $("reading-form").hidden = !waits || gate.doubt !== null;
  $("take").textContent = gate.reads.length ? "Take" : "It touches";
  $("reading-label").textContent = gate.reads.join(", ") || "Touch";
  $("ask").hidden = !gate.asks;
  $("again").hidden = !gate.doubled;
  $("skip").hidden = next === null;
  const asked = next === null ? "" : `${next.number} ${next.joints}`;
  if (askedFor !== null && asked !== askedFor) $("reading").value = $("stood").value = "";  // typed for another touch
  askedFor = asked;
  $("undo").hidden = gate.made === 0 || gate.doubt !== null;
  $("help").textContent = gate.help;
  $("doubt").replaceChildren(...(gate.doubt === null ? [] : doubtful(gate.doubt)));
  const list = [...gate.touches].reverse();
  $("made").replaceChildren(...list.map((each) => el("tr", ["number", "where", "read", "purpose", "state"].map(
    (name) => el("td", each[name])), each.state === "in doubt" ? { class: "doubt" } : {})));
  $("going-on").hidden = gate.ended.length === 0;
  $("progress").replaceChildren(...progress(gate));
  if (gate.skipped.length) {
    const again = gate.skipped.flatMap((number) => [button(`Ask for touch ${number} again`, `s ${number}`), " "]);
    $("progress").append(el("p", ["Left out: ", ...again]));
  }
  if (gate.ended.length) $("progress").append(el("ul", gate.ended.map((words) => el("li", words)), { class: "said" }));
}

function showPosture(next, stands = null) {
  const joints = next === null ? [] : next.joints;
  $("posture").replaceChildren(...joints.map((value, k) => {
    const item = el("li", [el("small", state.joints[k]), value]);
    if (stands && stands.joints) item.append(el("small", `now ${stands.joints[k]}, off ${stands.off ? stands.off[k] : ""}`));
    return item;
  }));
}

function doubtful(doubt) {
  const parts = [el("p", doubt.what)];
  doubt.suspects.forEach((each, k) => {
    const line = el("p", each.words);
    if (each.can) line.append(" ", button("Correct it so", `c ${k + 1}`));
    parts.push(line);
  });
  const back = doubt.touches.flatMap((number) => [button(`Take touch ${number} back`, `u ${number}`), " "]);
  parts.push(el("p", [...back, button(`Keep touch ${doubt.suspect} as it is`, "k")]));
  return parts;
}

function button(words, line) {
  return el("button", words, { type: "button", "data-line": line });
}

function progress(gate) {
  const made = `${gate.made} touch${gate.made === 1 ? "" : "es"}`;
  const told = [el("p", gate.error === null
    ? `${made}; ${gate.distrust || "nothing is known of the tip error yet"}.`
    : `${made}: a tip error of ${gate.error} mm is expected, below ${gate.below} mm 19 times of 20, if the priors and the model are right.`)];
  const points = gate.curve.filter(([, error]) => error > 0);
  return points.length > 1 ? [...told, curve(points, gate.tolerance)] : told;
}

function curve(points, tolerance) {
  const space = "http://www.w3.org/2000/svg", wide = 400, high = 150, room = 44;
  const logs = points.map(([, error]) => Math.log10(error)).concat(tolerance ? [Math.log10(tolerance)] : []);
  const low = Math.min(...logs), most = Math.max(...logs, low + 0.1), last = points[points.length - 1][0];
  const x = (count) => room + (wide - room - 8) * count / last;
  const y = (error) => 10 + (high - 34) * (most - Math.log10(error)) / (most - low);
  const svg = document.createElementNS(space, "svg");
  const add = (tag, at, words) => {
    const part = document.createElementNS(space, tag);
    for (const [name, value] of Object.entries(at)) part.setAttribute(name, value);
    if (words !== undefined) part.textContent = words;
    svg.append(part);
  };
  svg.setAttribute("viewBox", `0 0 ${wide} ${high}`);
  svg.setAttribute("role", "img");
  const [first, end] = [points[0][1], points[points.length - 1][1]];
  svg.setAttribute("aria-label", `Expected tip error by number of touches: from ${first.toPrecision(2)} to ${end.toPrecision(2)} mm`);
  add("path", { d: `M${room} 4V${high - 22}H${wide}`, fill: "none", stroke: "#5b6875" });
  if (tolerance) add("path", { d: `M${room} ${y(tolerance)}H${wide}`, stroke: "#1c6b3c", "stroke-dasharray": "6 4" });
  add("path", { d: "M" + points.map(([count, error]) => `${x(count)} ${y(error)}`).join("L"), fill: "none", stroke: "#1d4f86", "stroke-width": 3 });
  for (const error of [10 ** most, 10 ** low]) add("text", { x: 0, y: y(error) + 4, "font-size": 12 }, error.toPrecision(2));
  add("text", { x: wide - 4, y: high - 6, "font-size": 12, "text-anchor": "end" }, `${last} touches; mm, logarithmic`);
  return svg;
}

function showDecision(gate) {
  $("verdict").textContent = gate.words || "";
  $("verdict").className = { "calibrated": "calibrated", "use with care": "care", "do not use": "no" }[gate.level] || "";
  const reasons = [...(gate.reasons || []), ...(gate.mirror ? [gate.mirror] : [])].filter((each) => !(gate.words || "").includes(each));
  $("reasons").replaceChildren(...reasons.map((words) => el("li", words)));
  $("calibrate").hidden = gate.state === "ahead";
  const there = state.files.includes("report.html"), old = $("report").dataset.madeFrom === gate.made_from;
  if (there && gateShown() === "decide" && state.job === null && !old) {
    $("report").dataset.madeFrom = gate.made_from;
    $("report").src = `/file/report.html?${state.version}`;
  }
  $("report").hidden = !there;
}

function showHandOver(gate) {
  $("correction").hidden = gate.state === "ahead";
  $("caution").textContent = gate.caution || "";
  const frames = gate.frames || [], chosen = $("frame").value;
  $("frame").replaceChildren(...frames.map(([value, words]) => el("option", words, { value })));
  if (frames.some(([value]) => value === chosen)) $("frame").value = chosen;
  $("files").replaceChildren(...state.files.map((name) => el("li", [el("a", name, {
    href: `/file/${name}`, target: "_blank", rel: "noopener",
  })])));
}

async function showSpace(shown) {
  const there = IN_SPACE.includes(shown) && state.gates.plan.touches.length > 0;
  $("space").hidden = !there;
  document.querySelector("main").classList.toggle("flat", !there);
  if (!there) return;
  try {
    if (space === null) space = import("/static/space.js").then(({ Space }) => new Space($("view")));
    const drawing = await space, plan = state.gates.plan.notes.join();
    if (spaceOf !== plan) {
      drawing.show(await ask("/space"));
      spaceOf = plan;
    }
  } catch (error) {
    $("view-words").textContent = `The picture cannot be shown here (${error.message}).`;
    return;
  }
  const next = shown === "measure" ? state.gates.measure.next : { number: touch || 1, where: "", arm: null };
  if (next === null) return;
  const drawing = await space;
  drawing.pose(next.arm || drawing.space.arms[next.number - 1]);
  const name = next.number === null ? "one more touch" : `touch ${next.number}`;
  $("view").setAttribute("aria-label", `The arm in its cell at ${name}${next.where ? ` of ${next.where}` : ""}; the arrow shows the way of approach`);
}

document.addEventListener("click", (event) => {
  const line = event.target.dataset ? event.target.dataset.line : undefined;
  if (line !== undefined) step("enter", { line }).then(() => $("reading").focus());
});
function submitted(form, send) {
  $(form).addEventListener("submit", (event) => {
    event.preventDefault();
    send();
  });
}
const entered = (field) => async () => {
  const line = $(field).value;
  if (!line.trim() && state.gates.measure.reads.length) return;
  const found = await step("enter", { line });
  if (found !== null && !state.gates.measure.failed) $(field).value = "";
  $(field).focus();
  $(field).select();
};
submitted("reading-form", entered("reading"));
submitted("elsewhere", entered("stood"));
submitted("going-on", () => step("go_on", { tolerance: $("wanted").value }));
submitted("planning", () => step("plan", { touches: $("touches").value, tolerance: $("plan-tolerance").value }));
submitted("pendant", () => step("conventions", { form: $("form").value, rows: $("rows").value }));
submitted("verification", () => step("verify", { tolerance: $("verify-tolerance").value }));
$("targets").addEventListener("change", () => $("corrected").replaceChildren());
submitted("correction", async () => {
  $("corrected").replaceChildren();
  const files = await Promise.all([...$("targets").files].map(async (file) => {
    const bytes = new Uint8Array(await file.arrayBuffer());
    let letters = "";
    for (const byte of bytes) letters += String.fromCharCode(byte);
    return { name: file.name, data: btoa(letters) };
  }));
  const found = await step("correct", { files, frame: $("frame").value, leave: $("leave").checked });
  if (found === null) return;
  const made = found.files.map(({ name, data }) => {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    return el("li", [el("a", `Save ${name}`, { href: URL.createObjectURL(new Blob([bytes])), download: name })]);
  });
  $("corrected").replaceChildren(...made, ...found.said.map((words) => el("li", words)));
});
$("calibrate").addEventListener("click", () => {
  $("corrected").replaceChildren();  // made by the calibration before
  step("calibrate");
});
$("ask").addEventListener("click", () => step("ask"));
$("form").addEventListener("change", () => showConventions(state.gates.conventions));
$("rows-joints").addEventListener("click", async () => {
  const stands = await ask("/stands");
  if (stands.error) $("trouble").textContent = stands.error;
  else $("rows").value += `${$("rows").value && !$("rows").value.endsWith("\n") ? "\n" : ""}${stands.joints.join(" ")} `;
  $("rows").focus();
});
window.addEventListener("hashchange", () => {
  if (state === null) return;
  show(state);
  const title = $(gateShown()).querySelector("h2");
  title.setAttribute("tabindex", "-1");
  (gateShown() === "measure" ? $("reading") : title).focus();
});

function listen() {
  const events = new EventSource("/events");
  events.onmessage = (event) => { if (state === null || Number(event.data) !== state.version) refresh(); };
  events.onerror = () => {
    if (!$("trouble").textContent) $("trouble").textContent = LOST;
    if (events.readyState === EventSource.CLOSED) setTimeout(() => { refresh(); listen(); }, 2000);
  };
  events.onopen = refresh;
}
setInterval(async () => {
  if (state === null || !state.gates.measure.controller || gateShown() !== "measure") return;
  try {
    const stands = await ask("/stands");
    if (stands.error) $("waiting").textContent = stands.error;
    else showPosture(state.gates.measure.next, stands);
  } catch { /* the events say it */ }
}, 2000);
listen();
