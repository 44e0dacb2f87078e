// Typesets the equations of a page with the KaTeX beside this file; pages without equations load nothing.
(() => {
  const here = document.currentScript.src.replace(/[^/]*$/, "") + "katex/";
  const typeset = () => {
    const equations = document.querySelectorAll(".arithmatex");
    if (!equations.length) return;
    const style = document.createElement("link");
    style.rel = "stylesheet";
    style.href = here + "katex.min.css";
    const script = document.createElement("script");
    script.src = here + "katex.min.js";
    script.onload = () => equations.forEach((equation) => {
      const text = equation.textContent.trim();
      const displayMode = text.startsWith("\\[");
      katex.render(text.slice(2, -2), equation, { displayMode, throwOnError: false });
    });
    document.head.append(style, script);
  };
  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", typeset);
  else typeset();
})();
