"use strict";
// A link into a folded part opens it; printing opens all.
const unfold = (part) => { for (; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true; };
const reveal = (hash) => {
  const target = document.getElementById(decodeURIComponent(hash.slice(1)));
  if (!target) return;
  unfold(target);
  target.querySelectorAll("details").forEach(unfold);
  target.scrollIntoView();
};
addEventListener("hashchange", () => reveal(location.hash));
addEventListener("click", (event) => { const link = event.target.closest?.('a[href^="#"]'); if (link) reveal(link.hash); });
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(unfold));
if (location.hash) reveal(location.hash);
