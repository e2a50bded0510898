const pressed = $pressed;
export default { render({ model, el }) {
  const show = () => { el.innerHTML = model.get('value'); };
  const send = text => { model.set('sent', text); model.save_changes(); };
  show();
  model.on('change:value', show);
  el.onpointerdown = event => pressed(event, send);
} };
