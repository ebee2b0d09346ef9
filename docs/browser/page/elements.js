// Elements of the page that both tasks use.

/**
 * @param {string} kind
 * @param {string} name of its class
 * @param {string} text
 * @returns {HTMLElement}
 */
export function elementOf(kind, name, text) {
  const element = document.createElement(kind);
  element.className = name;
  element.textContent = text;
  return element;
}

/**
 * The card of an object: its name, its value, whether it is asked for, and its buttons.
 * @param {string} name
 * @param {[string, string, () => void][]} actions the text of each button, what it does in words, and what it does
 */
export function cardOf(name, actions) {
  const box = elementOf('div', 'cube', '');
  const value = elementOf('span', 'arrow', '');
  const asked = elementOf('span', 'asked', '');
  const turns = elementOf('span', 'turns', '');
  const buttons = actions.map(([text, words, act]) => {
    const button = elementOf('button', '', text);
    button.type = 'button';
    button.setAttribute('aria-label', words);
    button.addEventListener('click', act);
    return button;
  });
  turns.append(...buttons);
  box.append(elementOf('span', 'name', name), document.createElement('br'), value, asked, turns);
  return { box, value, asked, buttons };
}

/**
 * A sentence in which each value is the name of a key.
 * @param {TemplateStringsArray} texts
 * @param {...string} keys
 * @returns {(string|HTMLElement)[]}
 */
export function keysOf(texts, ...keys) {
  return texts.flatMap((text, index) => (index < keys.length ? [text, elementOf('kbd', '', keys[index])] : [text]));
}
