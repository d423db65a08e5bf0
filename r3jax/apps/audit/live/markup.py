"""The page of a guide: one file, without anything from elsewhere, that asks for news."""

MARKUP = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>r3jax: where to go next</title>
<style>
 body { font: 16px/1.45 system-ui, sans-serif; color: #1f2937; background: #f3f4f6; margin: 0 }
 main { max-width: 980px; margin: 0 auto; padding: 14px 14px 40px }
 #next { background: #075985; color: white; border-radius: 12px; padding: 14px 18px;
   font-size: 22px; font-weight: 600; line-height: 1.3 }
 #next small { display: block; font-size: 14px; font-weight: 400; opacity: .85; margin-top: 4px }
 #next.stale { background: #64748b }
 #bar { height: 16px; background: #e5e7eb; border-radius: 8px; overflow: hidden;
   margin: 14px 0 4px }
 #bar i { display: block; height: 100%; width: 0; background: #16a34a; transition: width .3s }
 #done { margin: 0; color: #374151 }
 #warn { margin: 10px 0 0; padding: 0; list-style: none }
 #warn li { background: #fef3c7; border-left: 4px solid #d97706; padding: 6px 10px; margin: 6px 0;
   border-radius: 4px; font-size: 15px }
 .row { display: flex; flex-wrap: wrap; gap: 14px; margin-top: 14px }
 .card { background: white; border-radius: 12px; padding: 12px; box-shadow: 0 1px 3px #0001;
   flex: 1 1 280px }
 .card h2 { font-size: 14px; color: #6b7280; margin: 0 0 8px; font-weight: 600 }
 .card svg { width: 100%; max-height: 62vh; display: block }
 .card img { max-width: 100%; display: block; margin: 0 auto; border-radius: 6px }
 .key { font-size: 13px; color: #6b7280; margin: 8px 0 0 }
</style></head><body><main>
<div id="next" class="stale">Waiting for the first frame ...</div>
<div id="bar"><i></i></div><p id="done"></p><ul id="warn"></ul>
<div class="row">
 <div class="card" style="flex-grow:2"><h2>From above</h2>
  <svg id="plan" preserveAspectRatio="xMidYMid meet"></svg>
  <p class="key">Surfaces from red (would render badly) to green; white is free, gray unknown.
   Black: you, and where you looked. Blue: where to go, and what to look at.</p></div>
 <div class="card"><h2 id="name">Latest picture</h2><img id="latest" alt=""></div>
</div></main>
<script>
"use strict";
const at = id => document.getElementById(id);
const NS = "http://www.w3.org/2000/svg";
let shown = -1, failures = 0;
function put(svg, kind, values) {
  const made = document.createElementNS(NS, kind);
  for (const [name, value] of Object.entries(values)) made.setAttribute(name, value);
  svg.appendChild(made);
  return made;
}
function wedge(view, reach) {
  const rim = [-1, 0, 1].map(k => view.azimuth + k * view.half);
  return [[view.x, view.y], ...rim.map(a => [view.x + reach * Math.cos(a),
    view.y + reach * Math.sin(a)])].map(([x, y]) => x + "," + -y).join(" ");
}
function draw(news) {
  const svg = at("plan"), [left, right, bottom, top_] = news.extent;
  const size = Math.max(right - left, top_ - bottom), thin = size / 260;
  svg.replaceChildren();
  svg.setAttribute("viewBox", [left, -top_, right - left, top_ - bottom].join(" "));
  put(svg, "image", {href: "plan.png?" + news.version, x: left, y: -top_, width: right - left,
    height: top_ - bottom, preserveAspectRatio: "none", style: "image-rendering: pixelated"});
  put(svg, "polyline", {points: news.path.map(([x, y]) => x + "," + -y).join(" "), fill: "none",
    stroke: "#1f2937", "stroke-width": thin, opacity: .6});
  if (news.target) {
    put(svg, "polyline", {points: news.way.map(([x, y]) => x + "," + -y).join(" "), fill: "none",
      stroke: "#0284c7", "stroke-width": 2.5 * thin, "stroke-dasharray": 5 * thin});
    put(svg, "polygon", {points: wedge(news.target, .12 * size), fill: "#0ea5e9", opacity: .6});
    put(svg, "circle", {cx: news.target.x, cy: -news.target.y, r: .022 * size, fill: "#075985"});
  }
  put(svg, "polygon", {points: wedge(news.camera, .08 * size), fill: "#111827", opacity: .35});
  put(svg, "circle", {cx: news.camera.x, cy: -news.camera.y, r: .018 * size, fill: "#111827"});
}
async function ask() {
  try {
    const news = await (await fetch("news.json?" + shown)).json();
    failures = 0;
    if (news.version !== shown) {
      shown = news.version;
      at("next").textContent = news.next;
      at("next").className = news.is_current ? "" : "stale";
      const note = document.createElement("small");
      note.textContent = news.note;
      at("next").appendChild(note);
      at("warn").replaceChildren(...news.warnings.map(text => {
        const line = document.createElement("li");
        line.textContent = text;
        return line;
      }));
      if (news.extent) {
        at("bar").firstChild.style.width = 100 * news.fine_share + "%";
        at("done").textContent = news.done;
        at("name").textContent = "Latest picture: " + news.name;
        at("latest").src = "latest.png?" + news.version;
        draw(news);
      }
    }
  } catch (error) {
    if (++failures === 8) {
      at("next").textContent = "The scan has ended.";
      at("next").className = "stale";
    }
  }
  setTimeout(ask, 150);
}
ask();
</script></body></html>
"""
"""The page; it shows what `/news.json` says, and asks again seven times a second."""
