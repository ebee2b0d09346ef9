"""The section on the world itself: its certificate, which any result has to be read against."""

from __future__ import annotations

from imagine_bench.exact.certificate import Certificate, certificate_rows
from imagine_bench.report import figures
from imagine_bench.report.tables import Section, Table
from imagine_bench.report.text import percent


def world(found: Certificate) -> Section:
    """What follows from the rules alone."""
    figure = figures.image(
        "plans", lambda: figures.plan_lengths_figure(found.plan_lengths), svg=True, dpi=180,
        alt="How many starts need how many macro-actions at least.",
        caption="Fewest macro-actions after which a success is possible, by start.",
    )  # fmt: skip
    rows = {
        "macrostates": f"{found.macrostates:,}, {found.starts:,} of them starts; {found.horizon} macro-actions",
        "chance level": f"{percent(found.chance_level)} % by uniformly random macro-actions",
        "optimum": f"{percent(found.optimum)} % by perfect play that remembers all that frames showed",
        **certificate_rows(found),
    }
    return Section(
        title="The world",
        words=("Nothing here is measured: all of it follows from the rules, by enumeration.",),
        images=(figure,),
        tables=(Table(name="certificate", header=["", "certificate"], rows=[*map(list, rows.items())], prose=True),),
    )
