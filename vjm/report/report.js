// What a report does beyond showing: plots to zoom into, a pause of the animation, folded parts that print.
"use strict";

const color = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const make = (tag, attributes, ...children) => {
  const element = Object.assign(document.createElement(tag), attributes);
  element.append(...children);
  return element;
};

function plots(box) {
  const data = JSON.parse(box.querySelector("script").textContent);
  const roles = Object.keys(data.labels);
  const shown = {measured: true, ...Object.fromEntries(roles.map(role => [role, true]))};
  const picture = make("div");
  let drawn = [];

  const recording = make("select", {}, ...data.recordings.map((each, k) => new Option(each.label, k)));
  recording.value = data.first;
  const signal = make("select");
  const current = () => data.recordings[recording.value].signals[signal.value];

  function offer() {  // the signals of a recording; the chosen one stays where there is one of its name
    const {signals, first} = data.recordings[recording.value];
    const name = signal.selectedOptions[0]?.text ?? first;
    signal.replaceChildren(...signals.map((each, k) => new Option(each.name, k)));
    const named = wanted => signals.findIndex(each => each.name === wanted);
    signal.value = Math.max(named(name), named(first) * (named(name) < 0), 0);
    draw();
  }

  function draw() {
    const {times} = data.recordings[recording.value], now = current();
    const time = times[now.time], present = roles.filter(role => role in now);
    const scaled = values => values.map(value => value === null ? null : value * now.step);
    const residual = role => now.measured.map((value, k) => now[role][k] === null ? null : (value - now[role][k]) * now.step);
    drawn.forEach(each => each.destroy());
    const line = role => ({label: data.labels[role], key: role, stroke: () => color(role), width: 1.6,
      dash: role === "reference" ? [7, 4] : undefined, points: {show: false}, spanGaps: true});
    const measured = {label: "measured", key: "measured", stroke: () => color("measured"), width: 3, spanGaps: true,
      points: {size: 6, width: 1.5, stroke: () => color("measured"), fill: () => color("paper")}};
    drawn = [
      plot(`${now.name} [${now.unit}]`, [time, scaled(now.measured), ...present.map(role => scaled(now[role]))],
        [measured, ...present.map(role => ({...line(role), paths: uPlot.paths.spline()}))], now, 0),
      plot(`residual [${now.unit}]`, [time, ...present.map(residual)],
        present.map(role => ({...line(role), width: 1, dash: undefined})), now, 2 * now.noise),
    ];
  }

  function plot(label, values, series, now, band) {
    const digits = Math.max(0, -Math.floor(Math.log10(now.step)));
    const value = (_, number) => number === null || number === undefined ? "–" : number.toFixed(digits);
    const axis = {stroke: () => color("ink"), grid: {stroke: () => color("line"), width: 1}, ticks: {show: false}};
    const y = (u, low, high) => band ? uPlot.rangeNum(Math.min(low, -band), Math.max(high, band), 0.05, true)
      : uPlot.rangeNum(low, high, 0.08, true);
    const options = {
      width: width(), height: band ? 190 : 280, legend: {live: true}, scales: {x: {time: false}, y: {range: y}},
      cursor: {sync: {key: `vjm ${number}`, scales: ["x", null]}, drag: {x: true, y: false}},
      axes: [{...axis, label: "time [s]", size: 40, labelSize: 22}, {...axis, label, size: 62, labelSize: 22}],
      series: [{label: "time [s]", value: (_, t) => t === null || t === undefined ? "–" : t.toFixed(4)},
        ...series.map(each => ({...each, show: shown[each.key], value}))],
      hooks: {
        drawClear: [u => {
          if (!band) return;
          const [top, bottom] = [band, -band].map(at => u.valToPos(at, "y", true));
          u.ctx.fillStyle = color("band");
          u.ctx.fillRect(u.bbox.left, top, u.bbox.width, bottom - top);
        }],
        setScale: [(u, key) => {
          if (key !== "x") return;
          const {min, max} = u.scales.x;
          drawn.filter(other => other !== u && (other.scales.x.min !== min || other.scales.x.max !== max))
            .forEach(other => other.setScale("x", {min, max}));
        }],
      },
    };
    const drawing = new uPlot(options, values, picture);
    touchable(drawing, show);
    return drawing;
  }

  function show(time, share, length) {  // so much, with a time at a share of the width, as far as the recording has it
    const times = drawn[0].data[0], first = times[0], last = times[times.length - 1];
    length = Math.min(Math.max(length, 4 * (last - first) / (times.length - 1)), last - first);
    const start = Math.min(Math.max(time - share * length, first), last - length);
    drawn.forEach(each => each.setScale("x", {min: start, max: start + length}));
  }

  function zoom(wider, later) {
    const {min, max} = drawn[0].scales.x, length = (max - min) * wider;
    show((min + max) / 2 + later * length, 0.5, length);
  }

  const width = () => Math.max(240, picture.clientWidth);
  const resize = () => drawn.forEach(each => each.setSize({width: width(), height: each.height}));
  const button = (text, name, action) => make("button", {type: "button", textContent: text, title: name,
    ariaLabel: name, onclick: action});
  const toggle = name => {
    const box = make("input", {type: "checkbox", checked: true});
    box.onchange = () => {
      shown[name] = box.checked;
      drawn.forEach(each => each.series.forEach((series, k) => series.key === name && each.setSeries(k, {show: box.checked})));
    };
    return make("label", {}, box, make("span", {className: `key ${name}`, textContent: data.labels[name] ?? name}));
  };
  const number = plots.count = (plots.count ?? 0) + 1;  // plots of one box share a cursor
  recording.onchange = offer;
  signal.onchange = draw;
  box.append(make("div", {className: "controls"}, make("label", {}, "Recording", recording),
    make("label", {}, "Signal", signal), ...["measured", ...[...roles].reverse()].map(toggle)),
  make("div", {className: "controls"}, button("+", "Zoom in", () => zoom(0.5, 0)),
    button("−", "Zoom out", () => zoom(2, 0)), button("◀", "Earlier", () => zoom(1, -0.5)),
    button("▶", "Later", () => zoom(1, 0.5)), button("Whole recording", "Whole recording", () => show(0, 0, Infinity)),
    matchMedia("(pointer: coarse)").matches ? "or pinch a plot and drag it sideways; double tap: whole recording"
      : "or drag over a plot; double click: whole recording"), picture);
  box.hidden = false;
  offer();
  new ResizeObserver(resize).observe(picture);
  const redraw = () => drawn.forEach(each => each.redraw());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  addEventListener("beforeprint", redraw);
  addEventListener("afterprint", redraw);
}

// Two fingers zoom along time, one drags sideways, a double tap shows all; up and down, one finger scrolls the page.
function touchable(plot, show) {
  const over = plot.over, slop = 10, twice = 350;  // px, ms: as browsers tell a tap from a drag and a double tap from two
  let grip = null, tap = null;

  function hold({targetTouches}) {  // where the fingers are: their middle as a share of the width, and their distance
    const {left, width} = over.getBoundingClientRect(), [first, second = first] = targetTouches;
    const apart = targetTouches.length > 1 ? Math.hypot(first.clientX - second.clientX, first.clientY - second.clientY) : 1;
    return {x: first.clientX, y: first.clientY, apart: Math.max(apart, 1),
      middle: ((first.clientX + second.clientX) / 2 - left) / width};
  }

  function take(event, moving) {
    const {min, max} = plot.scales.x, now = hold(event);
    grip = {...now, moving, since: event.timeStamp, length: max - min, time: min + now.middle * (max - min)};
  }

  over.addEventListener("touchstart", event => {
    const several = event.targetTouches.length > 1;
    if (several) event.preventDefault();  // or the browser would scroll
    take(event, several);
  }, {passive: false});

  over.addEventListener("touchmove", event => {
    if (!grip || !event.cancelable) {  // the browser scrolls
      grip = null;
      return;
    }
    const now = hold(event), right = Math.abs(now.x - grip.x), down = Math.abs(now.y - grip.y);
    if (!grip.moving) {
      if (Math.max(right, down) < slop) return;
      if (down >= right) {
        grip = null;
        return;
      }
      take(event, true);
    }
    event.preventDefault();  // the first one decides: without, the browser takes the finger
    show(grip.time, now.middle, grip.length * grip.apart / now.apart);
  }, {passive: false});

  over.addEventListener("touchend", event => {
    if (event.targetTouches.length) {
      take(event, true);
      return;
    }
    const ended = grip && !grip.moving && event.timeStamp - grip.since < twice ? {...grip, at: event.timeStamp} : null;
    const again = ended && tap && ended.at - tap.at < twice && Math.hypot(ended.x - tap.x, ended.y - tap.y) < 3 * slop;
    if (again) show(0, 0, Infinity);
    tap = again ? null : ended;
    grip = null;
  });
  over.addEventListener("touchcancel", () => { grip = tap = null; });
}

function pausable(figure) {
  const svg = figure.querySelector("svg"), still = Number(svg.dataset.still);
  const button = make("button", {type: "button"});
  const show = () => { button.textContent = svg.animationsPaused() ? "Play" : "Pause"; };
  button.onclick = () => { svg.animationsPaused() ? svg.unpauseAnimations() : svg.pauseAnimations(); show(); };
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
    svg.pauseAnimations();
    svg.setCurrentTime(still);
  }
  figure.querySelector("figcaption").append(button);
  show();
}

const folded = () => [...document.querySelectorAll("details:not([open])")];
const unfold = () => document.getElementById(decodeURIComponent(location.hash.slice(1)))?.closest("details")?.setAttribute("open", "");
let unfolded = [];
function printing(begins) {
  document.documentElement.classList.toggle("printing", begins);  // in light colours, plots too
  unfolded = begins ? folded() : unfolded;
  unfolded.forEach(each => { each.open = begins; });
}
addEventListener("beforeprint", () => printing(true));
addEventListener("afterprint", () => printing(false));
addEventListener("hashchange", unfold);
document.querySelectorAll(".contents a").forEach(link => link.addEventListener("click", () => setTimeout(unfold)));
unfold();
document.querySelectorAll(".plots").forEach(plots);
document.querySelectorAll("figure.motion").forEach(pausable);
