// Watches the viewer from outside. A browser that draws more slowly than data arrive falls behind and keeps what it has
// not drawn: the page then says so, and is loaded again before its memory grows without a limit. It begins with the newest
// data.
const PAUSE_MS = 4000;
if (sessionStorage.getItem("pause")) {  // without a pause the old page's memory is still in use when this one loads
  sessionStorage.removeItem("pause");
  window.stop();
  document.documentElement.innerHTML = "<body>The viewer is loaded again, with the newest data.</body>";
  setTimeout(() => location.reload(), PAUSE_MS);
} else if (location.search.includes("proxy")) {  // a recording that is read once does not fall behind
  const LARGEST_BYTES = 300e6, LARGEST_SLOW_BYTES = 270e6, LOOK_MS = 5000, FEWEST_FRAMES = 15;
  let memory = null, frames = 0, slow = 0;
  const keep = (found) => { memory = (found.instance || found).exports.memory; return found; };
  for (const name of ["instantiate", "instantiateStreaming"]) {
    const original = WebAssembly[name];
    WebAssembly[name] = (...all) => original(...all).then(keep);
  }
  const count = () => { frames += 1; requestAnimationFrame(count); };
  requestAnimationFrame(count);
  const notice = document.createElement("div");
  notice.textContent = "This browser draws too slowly: the pictures may be old. 'safedpa status' shows the present.";
  notice.style = "position:fixed;top:0;left:30%;z-index:9;padding:4px 12px;background:#d55e00;color:#fff;font:14px sans-serif";
  setInterval(() => {
    slow = frames < FEWEST_FRAMES && !document.hidden ? slow + 1 : 0;
    frames = 0;
    // The memory grows in steps of 34 MB; a slow browser takes the next one before it is looked at again.
    const largest = slow > 1 ? LARGEST_SLOW_BYTES : LARGEST_BYTES;
    if (memory !== null && memory.buffer.byteLength > largest) {
      sessionStorage.setItem("pause", "1");
      location.reload();
    }
    if (slow > 1) document.body.append(notice); else notice.remove();
  }, LOOK_MS);
}
