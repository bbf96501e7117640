// What a person would find wrong at a glance, in the part of the page that can be seen: [what, text, ...].
([width]) => {
  const found = [];
  const root = document.querySelector('.q-dialog') ?? document.body;
  if (document.documentElement.scrollWidth > width) found.push(['wider than the screen', document.documentElement.scrollWidth]);
  const seen = (node) => node.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true });
  const scrolls = (node) => {
    for (let at = node; at && at !== document.body; at = at.parentElement)
      if (['auto', 'scroll'].includes(getComputedStyle(at).overflowX)) return true;
    return false;
  };
  // the box within which a node can be seen
  const window_of = (node) => {
    let [left, top, right, bottom] = [0, 0, width, 1e6];
    for (let at = node.parentElement; at; at = at.parentElement) {
      const style = getComputedStyle(at);
      if (style.overflowX === 'visible' && style.overflowY === 'visible') continue;
      const box = at.getBoundingClientRect();
      if (style.overflowX !== 'visible') { left = Math.max(left, box.left); right = Math.min(right, box.right); }
      if (style.overflowY !== 'visible') { top = Math.max(top, box.top); bottom = Math.min(bottom, box.bottom); }
    }
    return [left, top, right, bottom];
  };
  // contrast of letters with what they stand on, as the guidelines count it (WCAG 2.2, 1.4.3)
  const numbers = (colour) => {
    const parts = (colour.match(/[\d.]+/g) ?? []).map(Number);
    return parts.length < 3 ? null : [parts[0], parts[1], parts[2], parts[3] ?? 1];
  };
  const over = (top, below) => [0, 1, 2].map((at) => top[3] * top[at] + (1 - top[3]) * below[at]).concat(1);
  const light = (colour) => {
    const [red, green, blue] = colour.map((part) => part / 255).map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4));
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const below = (node) => {
    const layers = [];
    for (let at = node; at; at = at.parentElement) {
      const colour = numbers(getComputedStyle(at).backgroundColor);
      if (colour && colour[3] > 0) layers.push(colour);
      if (colour && colour[3] === 1) break;
    }
    return layers.reverse().reduce((seen, layer) => over(layer, seen), [255, 255, 255, 1]);
  };
  const pale = (node) => {
    if (node.closest('[disabled], [aria-disabled=true], .disabled')) return 0;
    const style = getComputedStyle(node), letters = numbers(node instanceof SVGElement ? style.fill : style.color);
    if (!letters) return 0;
    for (let at = node; at; at = at.parentElement) letters[3] *= Number(getComputedStyle(at).opacity);
    const ground = below(node), [dim, bright] = [light(over(letters, ground)), light(ground)].sort((one, other) => one - other);
    const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    const ratio = (bright + 0.05) / (dim + 0.05);
    return ratio < (large ? 3 : 4.5) - 0.01 ? ratio : 0;
  };
  const texts = [];
  const walker = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement, text = node.textContent.trim();
    if (!text || !parent || !seen(parent) || parent.closest('script, style, .skip, .sr-only, .q-tooltip, .q-notifications')) continue;
    const ratio = pale(parent);
    if (ratio) found.push(['too pale', text.slice(0, 40), ratio.toFixed(2)]);
    const range = document.createRange();
    range.selectNodeContents(node);
    const [left, top, right, bottom] = window_of(parent);
    for (const box of range.getClientRects()) {
      if (box.width < 2 || box.height < 2) continue;
      const clipped = { left: Math.max(box.left, left), top: Math.max(box.top, top), right: Math.min(box.right, right), bottom: Math.min(box.bottom, bottom) };
      if (!scrolls(parent) && (box.right > right + 1.5 || box.left < left - 1.5)) found.push(['cut off', text.slice(0, 60)]);
      if (clipped.right - clipped.left < 2 || clipped.bottom - clipped.top < 2) continue;
      texts.push({ ...clipped, text, parent });
    }
  }
  for (let one = 0; one < texts.length; one++)
    for (let other = one + 1; other < texts.length; other++) {
      const a = texts[one], b = texts[other];
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      if (across <= 3) continue;
      const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (down <= 0) continue;
      if (a.parent === b.parent || a.parent.contains(b.parent) || b.parent.contains(a.parent)) continue;
      const least = Math.min(a.bottom - a.top, b.bottom - b.top);
      if (down > 0.35 * least) found.push(['one text over another', a.text.slice(0, 40), b.text.slice(0, 40)]);
    }
  return [...new Set(found.map((line) => line.join(': ')))];
}
