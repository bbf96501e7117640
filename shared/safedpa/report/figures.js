// Draws the figures of a page: panels side by side on a wide screen, one below the other on a phone; dark where the
// reader's system is. A figure is what Python made of it: traces, and a layout whose axes have domains.
const drawing = (() => {
  const SETTINGS = { displaylogo: false, displayModeBar: false, responsive: true };
  const PHONE = 700; // px; below it panels stand one below the other
  const PANEL = 210, BETWEEN = 76, COLOUR_BAR = 64; // px
  const DARK = { ink: "#E6E9EC", soft: "#AEB7C0", grid: "#343C44", edge: "#12171C", "#222222": "#E6E9EC", "#0072B2": "#56B4E9",
    "#D55E00": "#EE7733", "#F0C4A4": "#8A5A38", "#B8C4CE": "#4C5863", "#333333": "#E6E9EC", "#FFFFFF": "#12171C" };
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const drawn = new Map();

  const axesOf = (layout) => Object.keys(layout).filter((key) => key.startsWith("xaxis"))
    .sort((one, other) => Number(one.slice(5) || 1) - Number(other.slice(5) || 1))
    .map((key) => [layout[key], layout[`yaxis${key.slice(5)}`]]);

  function stacked(figure) { // in place
    const { layout } = figure;
    const panels = axesOf(layout);
    const bar = figure.data.find((trace) => trace.showscale !== false && trace.colorbar);
    const tall = panels.map(([, y]) => (y.scaleanchor ? 300 : PANEL));
    const total = tall.reduce((sum, height) => sum + height, 0) + BETWEEN * (panels.length - 1);
    const moved = new Map();
    let top = 1;
    panels.forEach(([x, y], index) => {
      moved.set(`${x.domain[0]} ${y.domain[1]}`, top);
      x.domain = [0, 1];
      y.domain = [Math.max(0, top - tall[index] / total), top];
      top -= (tall[index] + BETWEEN) / total;
    });
    for (const note of layout.annotations ?? []) {
      const at = moved.get(`${note.x} ${note.y}`);
      if (at !== undefined) Object.assign(note, { x: 0, y: at });
    }
    if (bar) Object.assign(bar.colorbar, { orientation: "h", x: 0.5, xanchor: "center", y: 1 + 34 / total, yanchor: "bottom", len: 1 });
    const legend = figure.data.some((trace) => trace.showlegend);
    const lines = legend ? 24 * new Set(figure.data.filter((trace) => trace.showlegend).map((trace) => trace.name)).size : 0;
    const above = 40 + (bar ? COLOUR_BAR : 0) + lines;
    if (legend) layout.legend = { orientation: "h", x: 0, xanchor: "left", y: 1 + 30 / total, yanchor: "bottom" };
    layout.margin = { l: 56, r: 12, t: above, b: 52 };
    layout.height = total + above + 52;
  }

  const recoloured = (value) => (typeof value === "string" ? DARK[value] ?? value : Array.isArray(value) ? value.map(recoloured) : value);

  function darkened(figure) { // in place
    const { layout } = figure;
    Object.assign(layout, { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { ...layout.font, color: DARK.ink } });
    for (const axis of axesOf(layout).flat()) {
      Object.assign(axis, { gridcolor: DARK.grid, zerolinecolor: DARK.soft });
      if (axis.title?.font) axis.title.font.color = DARK.ink;
    }
    for (const note of layout.annotations ?? []) if (note.font) note.font.color = DARK.ink;
    for (const shape of layout.shapes ?? []) if (shape.line) shape.line.color = recoloured(shape.line.color);
    for (const trace of figure.data)
      for (const part of [trace.line, trace.marker, trace.marker?.line, trace.error_y]) if (part?.color) part.color = recoloured(part.color);
  }

  function shown(id, figure) {
    const now = structuredClone({ data: figure.data, layout: figure.layout });
    if (innerWidth < PHONE) stacked(now);
    if (dark.matches && !matchMedia("print").matches) darkened(now);
    Plotly.purge(id); // what it was drawn with before leaves nothing behind, its height above all
    document.getElementById(id).style.height = `${now.layout.height}px`;
    Plotly.newPlot(id, now.data, now.layout, SETTINGS);
  }

  function draw(id, figure) { drawn.set(id, figure); shown(id, figure); }
  const again = () => drawn.forEach((figure, id) => shown(id, figure));
  dark.addEventListener("change", again);
  let phone = innerWidth < PHONE;
  addEventListener("resize", () => {
    if (phone === (innerWidth < PHONE)) return;
    phone = innerWidth < PHONE;
    again();
  });
  return { draw };
})();
