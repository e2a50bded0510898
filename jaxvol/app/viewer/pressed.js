/* Of both faces: handles `pointerdown`, and sends messages for `press_of`. What was pressed may be drawn anew while
the pointer moves. */
(event, send) => {
  const pad = event.target.closest('[data-pad]'), id = Date.now(), last = window.jaxvolPress ?? {};
  if (!pad || event.button) return;
  event.preventDefault();
  const box = pad.getBoundingClientRect(), name = pad.dataset.pad, part = event.target.dataset.part ?? '';
  const twice = part !== '' && last.key === name + part && id - last.id < 350;
  window.jaxvolPress = {key: name + part, id};
  const tell = at => {
    const x = (at.clientX - box.x) / box.width, y = (at.clientY - box.y) / box.height;
    send([id, name, part, twice, x.toFixed(5), y.toFixed(5)].join(','));
  };
  tell(event);
  if (twice) return;
  window.addEventListener('pointermove', tell);
  window.addEventListener('pointerup', () => window.removeEventListener('pointermove', tell), {once: true});
}
