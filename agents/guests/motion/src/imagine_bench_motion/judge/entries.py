"""The entry of each model of motions of this package; torch is not imported before one is made."""

from __future__ import annotations

from .interface import MotionModelEntry

NO_CHANGE = MotionModelEntry(
    make="imagine_bench_motion.judge.no_change:make",
    level="commands",
    description="Says that no motion changes anything: one end of the scale.",
)
LABELLED = MotionModelEntry(
    make="imagine_bench_motion.judge.labelled:make",
    level="macro-action",
    encoder_kind="latents",
    description="The thesis' model of macro-actions, told the goal of each motion; it sees no command.",
)
RECURRENT = MotionModelEntry(
    make="imagine_bench_motion.judge.recurrent:make",
    level="commands",
    description="A convolutional network sees the frame, a recurrent one reads the commands; plain torch.",
)
