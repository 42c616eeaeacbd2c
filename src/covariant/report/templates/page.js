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
  const rgb = [1, 3, 5].map((at) => parseInt(trace.meta.slice(at, at + 2), 16)).join();
  const copy = { ...trace };
  for (const part of ["line", "marker"]) if (trace[part]) copy[part] = { ...trace[part], color: trace.meta };
  if (trace.fillcolor) copy.fillcolor = trace.fillcolor.replace(/\d+,\d+,\d+/, rgb);
  return copy;
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
  const figures = JSON.parse(await unpack("figures"));
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
    await Plotly.newPlot(plot, data.map((trace) => shown(trace, true)), layout, config);
  }
  dark.addEventListener("change", () => {
    for (const [i, plot] of plots.entries()) {
      Plotly.react(plot, figures[i].data.map((trace, k) => shown(trace, plot.data[k].visible)), plot.layout, config);
    }
  });

  // One time axis for all figures.
  let following = false;
  async function follow(leader, change) {
    const time = Object.fromEntries(Object.entries(change).filter(([key]) => key.startsWith("xaxis.")));
    if (following || !Object.keys(time).length) return;
    following = true;
    await Promise.all(plots.filter((plot) => plot !== leader).map((plot) => Plotly.relayout(plot, { ...time })));
    following = false;
  }
  for (const plot of plots) plot.on("plotly_relayout", (change) => follow(plot, change));

  // One legend for all panels: a click switches a curve, a double click shows it alone, or all again.
  const buttons = [...document.querySelectorAll("nav button")];
  const isOn = (button) => button.getAttribute("aria-pressed") === "true";
  function show(wanted) {
    const next = buttons.map(wanted);
    buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(next[i])));
    const on = new Set(buttons.filter(isOn).map((button) => button.dataset.label));
    for (const plot of plots) {
      if (plot.data.length) Plotly.restyle(plot, { visible: plot.data.map((trace) => on.has(trace.legendgroup)) });
    }
  }
  for (const button of buttons) {
    button.addEventListener("click", () => show((other) => isOn(other) !== (other === button)));
    button.addEventListener("dblclick", () => {
      const alone = buttons.every((other) => isOn(other) === (other === button));
      show((other) => alone || other === button);
    });
  }
})();
