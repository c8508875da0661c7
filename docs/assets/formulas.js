for (const formula of document.querySelectorAll(".arithmatex")) {
  const text = formula.textContent.trim().slice(2, -2) // without \( \) or \[ \]
  katex.render(text, formula, { displayMode: formula.tagName == "DIV" })
}
