"use strict";
(async () => {
  const touch = matchMedia("(pointer: coarse)").matches;
  const config = { responsive: true, displaylogo: false, displayModeBar: touch || "hover",
                   modeBarButtons: [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]] };
  const plots = [...document.querySelectorAll(".figure")];
  const figures = JSON.parse(document.getElementById("figures").textContent);
  for (const [i, plot] of plots.entries()) {
    if (touch) figures[i].layout.dragmode = false; // a finger scrolls the page; zoom by the buttons
    await Plotly.newPlot(plot, figures[i].data, figures[i].layout, config);
  }

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
