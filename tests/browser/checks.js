// Checks of a page, as functions that return a list of faults.
({
  visible(e) {
    return e.checkVisibility({ visibilityProperty: true }) && e.getClientRects().length > 0;
  },

  name(e) {
    return `${e.tagName.toLowerCase()} "${(e.innerText || e.alt || e.id).trim().slice(0, 60)}"`;
  },

  // relative luminance and contrast as in WCAG 2.2
  channels(colour) {
    return colour.match(/[\d.]+/g).map(Number);
  },
  luminance(rgb) {
    const [r, g, b] = rgb.map((c) => (c / 255 <= 0.04045 ? c / 3294.6 : ((c / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  },
  background(e) {
    for (; e; e = e.parentElement) {
      const [r, g, b, a = 1] = this.channels(getComputedStyle(e).backgroundColor);
      if (a === 1) return [r, g, b];
      if (a > 0) throw new Error("a background that is half transparent");
    }
    return [255, 255, 255];
  },
  contrast(e) {
    const ink = this.luminance(this.channels(getComputedStyle(e).color).slice(0, 3));
    const background = this.luminance(this.background(e));
    return (Math.max(ink, background) + 0.05) / (Math.min(ink, background) + 0.05);
  },

  texts() {
    const elements = new Set();
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const e = walker.currentNode.parentElement;
      if (walker.currentNode.data.trim() && this.visible(e) && !["STYLE", "SCRIPT", "NOSCRIPT", "OPTION"].includes(e.tagName)) elements.add(e);
    }
    return [...elements];
  },
  lowContrast(minimum) {
    return this.texts().filter((e) => this.contrast(e) < minimum)
      .map((e) => `${this.name(e)}: contrast ${this.contrast(e).toFixed(2)}`);
  },
  smallText(minimum) {
    return this.texts().filter((e) => parseFloat(getComputedStyle(e).fontSize) < minimum)
      .map((e) => `${this.name(e)}: ${getComputedStyle(e).fontSize}`);
  },

  overflow(width) {
    const inBox = (e) => e.closest(".scroll, pre, .skip");
    return [...document.querySelectorAll("body *")]
      .filter((e) => this.visible(e) && !inBox(e) && e.getBoundingClientRect().right > width + 1)
      .map((e) => `${this.name(e)} ends at ${Math.round(e.getBoundingClientRect().right)} of ${width} px`)
      .concat(document.documentElement.scrollWidth > width ? [`the page is ${document.documentElement.scrollWidth} px wide`] : []);
  },

  headings() {
    const levels = [...document.querySelectorAll("h1, h2, h3, h4, h5, h6")].map((e) => Number(e.tagName[1]));
    const faults = levels.filter((level) => level === 1).length === 1 ? [] : ["not exactly one h1"];
    levels.forEach((level, i) => {
      if (i && level > levels[i - 1] + 1) faults.push(`h${level} follows h${levels[i - 1]}`);
    });
    return faults;
  },
  unlabelled() {
    const faults = [...document.images].filter((e) => e.alt.trim().length < 15).map((e) => `alt of ${this.name(e)}`);
    for (const table of document.querySelectorAll("table")) {
      if (![...table.querySelectorAll("thead th")].length) faults.push("a table without a head");
      faults.push(...[...table.querySelectorAll("th")].filter((e) => !e.scope).map((e) => `scope of ${this.name(e)}`));
      if (!table.closest("[aria-labelledby]")) faults.push("a table without a name");
    }
    for (const e of document.querySelectorAll("canvas")) if ((e.getAttribute("aria-label") || "").length < 15) faults.push("a canvas without words");
    for (const e of document.querySelectorAll("input, select, button")) if (!(e.innerText || e.closest("label")?.innerText || "").trim()) faults.push("a control without a name");
    for (const link of document.querySelectorAll("a")) if (!link.textContent.trim()) faults.push("a link without words");
    for (const part of ["main", "title"]) if (!document.querySelector(part)) faults.push(`no ${part}`);
    if (!document.documentElement.lang) faults.push("no language");
    return faults;
  },

  interactive() {
    return [...document.querySelectorAll('a[href], button, summary, input, select, [tabindex="0"]')].filter((e) => this.visible(e));
  },
  // the focused element: its index among interactive elements, and whether the focus is visible
  focus() {
    const e = document.activeElement;
    const style = getComputedStyle(e);
    const ring = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0;
    const box = e.getBoundingClientRect();
    const inside = box.bottom > 0 && box.top < innerHeight && box.right > 0 && box.left < innerWidth;
    return { index: this.interactive().indexOf(e), name: this.name(e), visible: ring && inside };
  },
  // parts of the page that are not in its file; links are allowed
  external() {
    const loaded = [...document.querySelectorAll("[src], link[href], object, iframe")];
    return loaded.filter((e) => !(e.src || "").startsWith("data:")).map((e) => e.outerHTML.slice(0, 100));
  },
});
