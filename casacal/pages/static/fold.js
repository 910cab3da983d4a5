// A fold of a report, drawn in space when it is first opened, from what stands in the page alone.
const part = (id) => document.getElementById(id).textContent;
document.getElementById("space-fold").addEventListener("toggle", async () => {
  const packed = Uint8Array.from(atob(part("space-three")), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const address = (text) => URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  const three = address(await new Response(unpacked).text());
  const { Space } = await import(address(part("space-code").replace("/static/three.module.min.js", three)));
  const space = new Space(document.getElementById("space-view")), data = JSON.parse(part("space-data"));
  space.show(data);
  space.map(data.map);
  space.pose(data.arms[0]);
}, { once: true });
