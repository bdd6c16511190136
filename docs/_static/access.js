// Tables and formulas that are wider than the page can be scrolled by the keyboard, and
// the button of a block of code is not announced as one more navigation.
const all = selector => document.querySelectorAll(selector);
const focusable = () => {
  for (const x of all(".md-typeset__scrollwrap, div.arithmatex"))
    x.scrollWidth > x.clientWidth ? (x.tabIndex = 0) : x.removeAttribute("tabindex");
  for (const x of all(".md-code__nav")) x.setAttribute("role", "presentation");
};
addEventListener("load", focusable);
addEventListener("resize", focusable);
