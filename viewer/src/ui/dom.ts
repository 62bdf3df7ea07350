// SPDX-License-Identifier: Apache-2.0

/** Find an element of the page by its id. */
// eslint-disable-next-line @typescript-eslint/no-unnecessary-type-parameters -- a typed look-up
export function byId<T extends HTMLElement = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`The page has no element ${id}.`);
  return found as T;
}

/** Make an element with properties and children; strings become text. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K, properties: Partial<HTMLElementTagNameMap[K]> = {}, ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/**
 * Fill a radio group with buttons of which one is chosen.
 *
 * @returns a function that chooses one, without a call of `onChoice`.
 */
export function segments(
  holder: HTMLElement, choices: Record<string, string>, onChoice: (name: string) => void,
): (name: string) => void {
  const buttons = Object.entries(choices).map(([name, label]) => {
    const button = make("button", { type: "button", textContent: label });
    button.setAttribute("role", "radio");
    button.dataset.name = name;
    button.onclick = () => { choose(name); onChoice(name); };
    return button;
  });
  const choose = (name: string): void => {
    for (const button of buttons) {
      const chosen = button.dataset.name === name;
      button.setAttribute("aria-checked", String(chosen));
      button.tabIndex = chosen ? 0 : -1;
    }
  };
  // Arrows choose within a radio group, as the ARIA practices ask for.
  holder.onkeydown = (event) => {
    const at = buttons.indexOf(event.target as HTMLButtonElement);
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (at < 0 || step === undefined) return;
    event.preventDefault();
    const next = buttons[(at + step + buttons.length) % buttons.length];
    next.focus();
    next.click();
  };
  holder.replaceChildren(...buttons);
  choose(Object.keys(choices)[0]);
  return choose;
}
