"use strict";
// Meshes that turn together: drag any panel of a row of panels (or use its arrow keys), Ctrl and wheel zooms,
// a double click goes back. One WebGL context draws every panel and its picture is copied into the panel.
(() => {
  const groups = JSON.parse(document.getElementById("meshes").textContent);
  const START = { yaw: -55, pitch: 24, zoom: 1 };
  const VERTEX = `#version 300 es
    in vec3 position;
    uniform mat3 turn;
    uniform float zoom;
    out vec3 seen;
    void main() {
      seen = turn * position;  // x right, y up, z towards the eye
      float depth = 5.0 - seen.z;
      gl_Position = vec4(seen.xy * zoom * 4.7, (depth - 5.0) * 1.2, depth);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 seen;
    out vec4 colour;
    void main() {
      vec3 n = normalize(cross(dFdx(seen), dFdy(seen)));
      if (n.z < 0.0) n = -n;  // both sides are lit: a hole shows as shape, not as black
      float key = max(dot(n, normalize(vec3(-0.45, 0.75, 0.65))), 0.0);
      float fill = max(dot(n, normalize(vec3(0.8, 0.1, 0.5))), 0.0);
      vec3 light = 0.30 + 0.78 * key * vec3(1.0, 0.96, 0.9) + 0.16 * fill * vec3(0.85, 0.93, 1.0);
      colour = vec4(pow(vec3(0.30, 0.46, 0.72) * light * 1.15, vec3(1.0 / 2.2)), 1.0);
    }`;

  const screen = document.createElement("canvas");
  const gl = screen.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true });
  const program = gl && linked(gl);

  function linked(gl) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.bindAttribLocation(made, 0, "position");
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    gl.useProgram(made);
    gl.enable(gl.DEPTH_TEST);
    return { turn: gl.getUniformLocation(made, "turn"), zoom: gl.getUniformLocation(made, "zoom") };
  }

  function uploaded(panel) {
    const bytes = Uint8Array.from(atob(panel.data), (c) => c.charCodeAt(0)).buffer;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Int16Array(bytes, 0, panel.vertices * 3), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.SHORT, true, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const indices = new Uint16Array(bytes, panel.vertices * 6, panel.faces * 3);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    return { array, count: panel.faces * 3 };
  }

  function rotation({ yaw, pitch }) {
    const [a, e] = [yaw * Math.PI / 180, pitch * Math.PI / 180];
    const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
    // rows right, up, towards the eye; WebGL wants columns
    return [-sa, -se * ca, ce * ca, ca, -se * sa, ce * sa, 0, ce, se];
  }

  function drawn(canvas, mesh, view) {
    const size = Math.round(canvas.clientWidth * Math.min(2, devicePixelRatio || 1)) || 200;
    if (canvas.width !== size) canvas.width = canvas.height = size;
    if (screen.width !== size) screen.width = screen.height = size;
    gl.viewport(0, 0, size, size);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(program.turn, false, rotation(view));
    gl.uniform1f(program.zoom, view.zoom);
    gl.bindVertexArray(mesh.array);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0);
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, size, size);
    pen.drawImage(screen, 0, 0);
  }

  function element(tag, parent, properties) {
    return parent.appendChild(Object.assign(document.createElement(tag), properties));
  }

  function viewer(place, shapes) {
    const view = { ...START };
    const bar = element("div", place, { className: "choices" });
    const grid = element("div", place, { className: "panels" });
    let panels = [];
    let waiting = false;
    const redraw = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => {
        waiting = false;
        for (const { canvas, mesh } of panels) drawn(canvas, mesh, view);
        place.dataset.drawn = panels.length;
      });
    };
    const turn = (x, y) => {
      view.yaw -= x;
      view.pitch = Math.max(-90, Math.min(90, view.pitch + y));
      redraw();
    };

    function show(shape, button) {
      for (const other of bar.children) other.setAttribute("aria-pressed", other === button);
      grid.replaceChildren();
      shape.uploaded ??= shape.panels.map(uploaded);
      panels = shape.panels.map((panel, k) => {
        const figure = element("figure", grid, {});
        const canvas = element("canvas", figure, { tabIndex: 0 });
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", `${panel.label}: ${shape.name}`);
        element("figcaption", figure, { textContent: panel.label });
        listen(canvas);
        return { canvas, mesh: shape.uploaded[k] };
      });
      redraw();
    }

    function listen(canvas) {
      canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
      canvas.onpointermove = (event) => {
        if (canvas.hasPointerCapture(event.pointerId)) turn(event.movementX * 0.6, event.movementY * 0.6);
      };
      canvas.ondblclick = () => { Object.assign(view, START); redraw(); };
      canvas.onwheel = (event) => {
        if (!event.ctrlKey) return;  // a plain wheel scrolls the page
        event.preventDefault();
        view.zoom = Math.max(0.5, Math.min(8, view.zoom * Math.exp(-event.deltaY / 400)));
        redraw();
      };
      canvas.onkeydown = (event) => {
        const step = { ArrowLeft: [-8, 0], ArrowRight: [8, 0], ArrowUp: [0, -8], ArrowDown: [0, 8] }[event.key];
        if (step) { event.preventDefault(); turn(...step); }
      };
    }

    for (const shape of shapes) {
      const button = element("button", bar, { type: "button", textContent: `${shape.name} (${shape.role})` });
      button.onclick = () => show(shape, button);
    }
    addEventListener("resize", redraw);
    show(shapes[0], bar.firstChild);
  }

  for (const place of document.querySelectorAll("[data-meshes]")) {
    if (gl) viewer(place, groups[Number(place.dataset.meshes)]);
    else place.textContent = "This browser has no WebGL 2. The pictures above show the same shapes.";
  }
})();
