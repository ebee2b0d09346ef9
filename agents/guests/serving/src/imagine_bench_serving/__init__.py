"""Tasks over HTTP, for language models and other programs: plain HTTP, the Model Context Protocol, and OpenEnv."""
