// A browser fetches neither modules nor WebAssembly for a page that was opened as a file: say so instead of nothing.
if (window.location.protocol === 'file:') {
  document.getElementById('loading').textContent = 'A browser does not load WebAssembly for a page opened as a file. '
    + 'In this folder run "python -m http.server", then open http://localhost:8000.';
}
