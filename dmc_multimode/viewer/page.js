/* What the live page adds to viser's client in the browser: title, icon, help,
   legend, keys and fields, gamepad, and a panel that folds in narrow windows.
   `web_client.py` sends it as a function of a configuration. It talks to the
   server by keys alone, those that the page has bound to commands. */
(config) => {
  'use strict';
  const first = !window.dmcMultimode;
  window.dmcMultimode = config; // A reconnection runs this once more.
  document.title = config.title;
  document.querySelector('link[rel="icon"]').href =
    'data:image/svg+xml,' + encodeURIComponent(config.icon);
  if (!first) return;

  const NARROW = 576; // Pixels: below, viser has a sheet instead of a panel.
  const SMALL = 800; // Below, a docked panel leaves no room for the robot.
  const IDLE = 2000; // Milliseconds after which a field gives the keys back.
  const TILT = 0.6; // Of a stick, from which it counts.

  const add = (tag, id, content = '') => {
    const element = document.createElement(tag);
    element.id = id;
    element.innerHTML = content;
    document.body.append(element);
    return element;
  };
  add('style', 'dmm-style', config.style);
  const press = (key) =>
    document.body.dispatchEvent(
      new KeyboardEvent('keydown', { key, bubbles: true }),
    );

  // Help, legend, and the status where the panel is folded away.
  add('div', 'dmm-legend', config.legend);
  const help = add('div', 'dmm-help', config.help);
  help.hidden = true;
  help.setAttribute('role', 'dialog');
  help.setAttribute('aria-label', 'Help');
  const opener = add('button', 'dmm-help-button', '?');
  opener.title = 'Help (? or H)';
  const toggleHelp = (shown = help.hidden) => {
    help.hidden = !shown;
    opener.blur(); // Else Space and Enter would press it again.
  };
  opener.addEventListener('click', () => toggleHelp());
  help.addEventListener('click', (event) => {
    if (event.target === help || event.target.closest('.dmm-close')) {
      toggleHelp(false);
    }
  });
  const mirror = add('div', 'dmm-mirror', '<div></div><div></div>');
  setInterval(() => {
    ['dmm-status', 'dmm-notice'].forEach((id, i) => {
      const content = document.getElementById(id)?.innerHTML ?? '';
      const shown = mirror.children[i];
      if (shown.innerHTML !== content) shown.innerHTML = content;
    });
  }, 200);
  document.addEventListener('click', (event) => {
    if (event.target.closest('.dmm-dismiss')) press('Escape');
  });

  // A field has the keys only as long as somebody types into it.
  const isField = (element) =>
    element instanceof HTMLInputElement &&
    !element.closest('[role="dialog"], .mantine-Spotlight-root');
  const leave = () => {
    if (isField(document.activeElement)) document.activeElement.blur();
  };
  let idle = 0;
  const wait = () => {
    clearTimeout(idle);
    idle = setTimeout(() => {
      const open = document.activeElement.getAttribute('aria-expanded');
      if (open === 'true') wait();
      else leave();
    }, IDLE);
  };
  document.addEventListener('focusin', (event) => {
    if (isField(event.target)) wait();
  });
  document.addEventListener('input', wait);
  document.addEventListener(
    'keydown',
    (event) => {
      if (event.target.closest?.('input, textarea')) return;
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === '?' || event.key.toLowerCase() === 'h') toggleHelp();
      else if (event.key === 'Escape' && !help.hidden) {
        toggleHelp(false);
        event.stopImmediatePropagation(); // It does not dismiss a notice too.
      }
    },
    true,
  );
  document.addEventListener(
    'pointerdown',
    (event) => {
      const inside = event.target.closest('input, .mantine-Input-wrapper');
      if (!inside && !event.target.closest('[role="listbox"]')) leave();
    },
    true,
  );
  // These bubble: the field's own handlers, which are React's, come first.
  document.addEventListener('keydown', (event) => {
    if (event.key === 'Enter' || event.key === 'Escape') leave();
  });
  document.addEventListener('click', (event) => {
    if (event.target.closest('[role="option"]')) leave();
    const button = event.target.closest('button');
    if (button && !button.closest('[role="dialog"]')) button.blur();
  });

  // The panel folds when a window is, or becomes, too narrow for both.
  const foldSheet = () => {
    const handle = [
      ...document.querySelectorAll('.mantine-Paper-root div'),
    ].find(
      (element) =>
        element.style.cursor === 'pointer' &&
        element.textContent.trim() === config.label &&
        element.closest('.mantine-Paper-root').style.position === 'fixed',
    );
    handle?.click();
    return Boolean(handle);
  };
  const foldDock = () => {
    const handle = document.querySelector(
      '[data-dock-region-collapse="right"][aria-expanded="true"]',
    );
    handle?.click();
    return Boolean(handle);
  };
  const kind = () =>
    innerWidth < NARROW ? 'narrow' : innerWidth < SMALL ? 'small' : 'wide';
  let shape = 'wide';
  const reshape = () => {
    if (kind() === shape) return;
    shape = kind();
    const wanted = shape;
    const fold = { narrow: foldSheet, small: foldDock, wide: () => true };
    let tries = 50; // Viser builds its panel some time later.
    const attempt = () => {
      if (shape === wanted && !fold[wanted]() && --tries) {
        setTimeout(attempt, 200);
      }
    };
    attempt();
  };
  addEventListener('resize', reshape);
  reshape();

  // A gamepad presses keys: at a press of a button, or a tilt of a stick.
  const held = new Set();
  const edge = (name, down, key) => {
    if (down && !held.has(name)) press(key);
    if (down) held.add(name);
    else held.delete(name);
  };
  const poll = () => {
    const pad = [...navigator.getGamepads()].find(
      (each) => each && each.mapping === 'standard',
    );
    if (pad) {
      for (const [button, key] of config.pad.buttons) {
        edge(`b${button}`, Boolean(pad.buttons[button]?.pressed), key);
      }
      for (const [axis, sign, key] of config.pad.axes) {
        edge(`a${axis}${sign}`, sign * pad.axes[axis] > TILT, key);
      }
    }
    document.body.classList.toggle('dmm-pad', Boolean(pad));
    setTimeout(poll, 30); // A control step; animation frames may be rarer.
  };
  if (navigator.getGamepads) poll();
};
