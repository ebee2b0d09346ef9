"""``python -m imagine_bench`` is the command ``imagine-bench``."""

from __future__ import annotations

from imagine_bench.cli import main

if __name__ == "__main__":
    main()
