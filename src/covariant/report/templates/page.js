"use strict";
// The text of an element that holds it compressed, in base 85: five letters stand for four bytes.
async function unpack(id) {
  const order = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;,=>?@^_`{|}~";
  const value = new Uint8Array(128);
  [...order].forEach((letter, i) => { value[letter.charCodeAt(0)] = i; });
  const element = document.getElementById(id), letters = element.textContent;
  const bytes = new DataView(new ArrayBuffer(letters.length / 5 * 4));
  for (let i = 0; i < letters.length; i += 5) {
    let word = 0;
    for (let k = i; k < i + 5; k++) word = word * 85 + value[letters.charCodeAt(k)];
    bytes.setUint32(i / 5 * 4, word);
  }
  const packed = new Blob([bytes.buffer.slice(0, Number(element.dataset.bytes))]);
  return new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).text();
}

// A curve in the colours of a dark page: its own in `meta`. Its colours on white stay in the figure, for downloads.
function darkened(trace) {
  const own = trace.meta.dark, rgb = [1, 3, 5].map((at) => parseInt(own.slice(at, at + 2), 16)).join();
  const copy = { ...trace };
  for (const part of ["line", "marker"]) if (trace[part]) copy[part] = { ...trace[part], color: own };
  if (trace.fillcolor) copy.fillcolor = trace.fillcolor.replace(/\d+,\d+,\d+/, rgb);
  return copy;
}

// Numbers as plotly for Python writes them: a type, and bytes in base 64.
function numbers(array) {
  if (Array.isArray(array)) return array;
  const types = { f4: Float32Array, f8: Float64Array, i1: Int8Array, i2: Int16Array, i4: Int32Array };
  return new types[array.dtype](Uint8Array.from(atob(array.bdata), (letter) => letter.charCodeAt(0)).buffer);
}

// The range of a y axis that fits what is seen of its curves in a range of time; undefined where there is nothing.
function fitting(data, axis, log, [first, last]) {
  let low = Infinity, high = -Infinity;
  for (const { x, y, yaxis, visible, meta } of data) {
    if (yaxis !== axis || !visible || !meta.fits) continue;
    for (let i = 0; i < x.length; i++) {
      if (x[i] < first || x[i] > last || !(y[i] > (log ? 0 : -Infinity))) continue;
      if (y[i] < low) low = y[i];
      if (y[i] > high) high = y[i];
    }
  }
  if (!(high >= low)) return undefined;
  if (log) [low, high] = [Math.log10(low), Math.log10(high)];
  const air = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
  return [low - air, high + air];
}

function save(name, text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}

(async () => {
  const touch = matchMedia("(pointer: coarse)").matches, dark = matchMedia("(prefers-color-scheme: dark)");
  const narrow = matchMedia("(max-width: 40rem)").matches;
  if (narrow) for (const details of document.querySelectorAll("details")) details.open = false;
  const plots = [...document.querySelectorAll(".figure")];
  if (!("DecompressionStream" in window)) {
    document.querySelector("main").textContent = "This browser is too old to unpack the figures; open the page in a newer one.";
    return;
  }
  const library = document.createElement("script");
  library.textContent = await unpack("plotly");
  document.head.append(library);
  const { stamps, figures } = JSON.parse(await unpack("figures"));
  const times = stamps.map(numbers);
  for (const { data } of figures) for (const trace of data) { trace.x = times[trace.x]; trace.y = numbers(trace.y); }
  const ranges = figures.map(({ layout }) => Object.fromEntries(
    Object.entries(layout).filter(([key]) => /^[xy]axis/.test(key)).map(([key, axis]) => [key, axis.range?.slice()])));
  const buttons = [...document.querySelectorAll("nav button")];
  const pressed = (button) => button.getAttribute("aria-pressed") === "true";
  const isOn = ({ legendgroup, meta }) => [legendgroup, meta.band].every((label) =>
    label === undefined || buttons.some((each) => each.dataset.label === label && pressed(each)));
  const shown = (trace, visible) => ({ ...(dark.matches ? darkened(trace) : trace), visible });
  const download = {
    name: "download", title: "Download the figure", icon: Plotly.Icons.camera,
    click(plot) {
      const data = figures[plots.indexOf(plot)].data.map((trace, k) => ({ ...trace, visible: plot.data[k].visible }));
      const layout = { ...plot.layout, paper_bgcolor: "white", plot_bgcolor: "white" };
      Plotly.downloadImage({ data, layout }, { format: "png", scale: 2, width: plot.clientWidth,
        height: plot.clientHeight, filename: document.title });
    },
  };
  const config = { responsive: true, displaylogo: false, displayModeBar: touch || "hover",
                   modeBarButtons: [[download], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]] };
  for (const [i, plot] of plots.entries()) {
    const { data, layout } = figures[i];
    if (touch) layout.dragmode = false; // a finger scrolls the page; zoom by the buttons
    if (narrow) layout.xaxis.nticks = 5;
    await Plotly.newPlot(plot, data.map((trace) => shown(trace, isOn(trace))), layout, config);
  }
  dark.addEventListener("change", () => {
    for (const [i, plot] of plots.entries()) {
      Plotly.react(plot, figures[i].data.map((trace, k) => shown(trace, plot.data[k].visible)), plot.layout, config);
    }
  });

  // One time axis for all figures, and y axes that fit what is seen of it; the whole of it has the ranges of the start.
  const timed = plots.filter((plot) => !plot.closest("section").classList.contains("lag"));
  function fitted(plot, range, anew = false) {
    const before = ranges[plots.indexOf(plot)], change = {};
    const whole = !anew && range[0] <= before.xaxis[0] && range[1] >= before.xaxis[1];
    for (const key of Object.keys(before).filter((each) => each.startsWith("yaxis"))) {
      const log = plot.layout[key].type === "log", axis = key.replace("axis", "").replace(/^y1$/, "y");
      const next = whole ? before[key] : fitting(plot.data, axis, log, range);
      if (next) change[`${key}.range`] = next.slice();
    }
    return change;
  }
  let following = false;
  async function follow(leader, change) {
    const keys = Object.keys(change);
    if (following || !keys.some((key) => key.startsWith("xaxis"))) return;
    following = true;
    const range = leader.layout.xaxis.range.slice();
    const chosen = keys.some((key) => key.startsWith("yaxis"));
    await Promise.all(timed.map((plot) => {
      if (plot === leader) return chosen ? undefined : Plotly.relayout(plot, fitted(plot, range));
      return Plotly.relayout(plot, { "xaxis.range": range.slice(), ...fitted(plot, range) });
    }));
    following = false;
  }
  for (const plot of timed) plot.on("plotly_relayout", (change) => follow(plot, change));

  const copy = document.getElementById("copy");
  copy?.addEventListener("click", async () => {
    await navigator.clipboard.writeText(copy.nextElementSibling.textContent);
    copy.textContent = "Copied";
  });
  const table = document.getElementById("csv");
  if (table) {
    const button = document.createElement("button");
    button.textContent = "Download the table (CSV)";
    button.className = "download";
    button.addEventListener("click", async () => save(`${document.title}.csv`, await unpack("csv")));
    document.querySelector(".hint").before(button);
  }

  // One legend for all panels: a click switches a curve, a double click shows it alone, or all again.
  function show(wanted) {
    const next = buttons.map(wanted);
    buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(next[i])));
    for (const plot of plots) {
      if (!plot.data.length) continue;
      const visible = plot.data.map(isOn);
      Plotly.restyle(plot, { visible }).then(() => {
        if (timed.includes(plot)) Plotly.relayout(plot, fitted(plot, plot.layout.xaxis.range, true));
      });
    }
  }
  for (const button of buttons) {
    button.addEventListener("click", () => show((other) => pressed(other) !== (other === button)));
    button.addEventListener("dblclick", () => {
      const alone = buttons.every((other) => pressed(other) === (other === button));
      show((other) => alone || other === button);
    });
  }
})();
