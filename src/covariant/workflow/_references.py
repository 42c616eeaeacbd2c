"""The works that observers are from: what `cite` prints, and `source` of the registry names."""

import re
from dataclasses import dataclass

ENTRY_KINDS = {"journal": "article", "booktitle": "inproceedings", "publisher": "book", "eprint": "misc"}
"""Kind of a BibTeX entry by the field that says where it appeared."""


@dataclass(frozen=True)
class Work:
    """A published work.

    Attributes:
        authors: Family and given names, "Family, Given", in the order of the work.
        year: Year of publication.
        title: Title.
        fields: Other fields by their names in BibTeX, one of `ENTRY_KINDS` among them.
    """

    authors: tuple[str, ...]
    year: int
    title: str
    fields: dict[str, str]

    @property
    def label(self) -> str:
        """How sentences name it: "Aghannan & Rouchon 2003"."""
        *others, last = [author.partition(",")[0] for author in self.authors]
        return f"{', '.join(others)}{' & ' if others else ''}{last} {self.year}"

    @property
    def key(self) -> str:
        """Key of its BibTeX entry: "aghannan2003"."""
        family = self.authors[0].partition(",")[0]
        return re.sub(r"[^a-z]", "", family.lower()) + str(self.year)

    @property
    def bibtex(self) -> str:
        """Its BibTeX entry."""
        kind = next(kind for field, kind in ENTRY_KINDS.items() if field in self.fields)
        fields = {"author": " and ".join(self.authors), "title": f"{{{self.title}}}", "year": str(self.year)}
        lines = ",\n".join(f"  {name} = {{{value}}}" for name, value in (fields | self.fields).items())
        return f"@{kind}{{{self.key},\n{lines}\n}}"

    def __str__(self) -> str:
        where = next(self.fields[field] for field in ENTRY_KINDS if field in self.fields)
        where = f"{self.fields['archiveprefix']}:{where}" if "archiveprefix" in self.fields else where
        number = f" {self.fields['volume']}" if "volume" in self.fields else ""
        number += f"({self.fields['number']})" if "number" in self.fields else ""
        pages = f", {self.fields['pages'].replace('--', '–')}" if "pages" in self.fields else ""
        doi = f", doi:{self.fields['doi']}" if "doi" in self.fields else ""
        return f"{self.label}: {self.title}. {where}{number}{pages}{doi}"


TAC = "IEEE Transactions on Automatic Control"
CDC = "IEEE Conference on Decision and Control"
AES = "IEEE Transactions on Aerospace and Electronic Systems"

WORKS = (
    Work(
        ("Aghannan, Nasradine", "Rouchon, Pierre"),
        2003,
        "An intrinsic observer for a class of Lagrangian systems",
        {"journal": TAC, "volume": "48", "number": "6", "pages": "936--945", "doi": "10.1109/TAC.2003.812778"},
    ),
    Work(
        ("Maithripala, D. H. S.", "Berg, Jordan M.", "Dayawansa, W. P."),
        2004,
        "An intrinsic observer for a class of simple mechanical systems on a Lie group",
        {"booktitle": "American Control Conference"},
    ),
    Work(
        ("Sanfelice, Ricardo G.", "Praly, Laurent"),
        2015,
        "Solution of a Riccati equation for the design of an observer contracting a Riemannian distance",
        {"booktitle": CDC},
    ),
    Work(
        ("Jouffroy, Jérôme", "Fossen, Thor I."),
        2004,
        "On the combination of nonlinear contracting observers and UGES controllers for output feedback",
        {"booktitle": CDC},
    ),
    Work(
        ("Rockafellar, R. Tyrrell",),
        1976,
        "Monotone operators and the proximal point algorithm",
        {
            "journal": "SIAM Journal on Control and Optimization",
            "volume": "14",
            "number": "5",
            "pages": "877--898",
            "doi": "10.1137/0314056",
        },
    ),
    Work(
        ("Ge, Yixiao", "van Goor, Pieter", "Mahony, Robert"),
        2025,
        "The geometry of extended Kalman filters on manifolds with affine connection",
        {"eprint": "2506.05728", "archiveprefix": "arXiv"},
    ),
    Work(("Gelb, Arthur",), 1974, "Applied optimal estimation", {"publisher": "MIT Press"}),
    Work(
        ("Lefferts, E. J.", "Markley, F. L.", "Shuster, M. D."),
        1982,
        "Kalman filtering for spacecraft attitude estimation",
        {
            "journal": "Journal of Guidance, Control, and Dynamics",
            "volume": "5",
            "number": "5",
            "pages": "417--429",
            "doi": "10.2514/3.56190",
        },
    ),
    Work(
        ("Barrau, Axel", "Bonnabel, Silvère"),
        2017,
        "The invariant extended Kalman filter as a stable observer",
        {"journal": TAC, "volume": "62", "number": "4", "pages": "1797--1812", "doi": "10.1109/TAC.2016.2594085"},
    ),
    Work(
        ("Julier, Simon J.", "Uhlmann, Jeffrey K."),
        2004,
        "Unscented filtering and nonlinear estimation",
        {
            "journal": "Proceedings of the IEEE",
            "volume": "92",
            "number": "3",
            "pages": "401--422",
            "doi": "10.1109/JPROC.2003.823141",
        },
    ),
    Work(
        ("Brossard, Martin", "Barrau, Axel", "Bonnabel, Silvère"),
        2020,
        "A code for unscented Kalman filtering on manifolds (UKF-M)",
        {"booktitle": "IEEE International Conference on Robotics and Automation"},
    ),
    Work(("Gardner, Floyd M.",), 2005, "Phaselock techniques", {"publisher": "Wiley", "edition": "3"}),
    Work(
        ("Kalata, Paul R.",),
        1984,
        "The tracking index: a generalized parameter for α-β and α-β-γ target trackers",
        {"journal": AES, "volume": "20", "number": "2", "pages": "174--182"},
    ),
    Work(
        ("Vasiljevic, Luma K.", "Khalil, Hassan K."),
        2008,
        "Error bounds in differentiation of noisy signals by high-gain observers",
        {"journal": "Systems & Control Letters", "volume": "57", "number": "10", "pages": "856--862"},
    ),
    Work(
        ("Khalil, Hassan K.", "Praly, Laurent"),
        2014,
        "High-gain observers in nonlinear feedback control",
        {
            "journal": "International Journal of Robust and Nonlinear Control",
            "volume": "24",
            "number": "6",
            "pages": "993--1015",
        },
    ),
    Work(
        ("Levant, Arie",),
        2003,
        "Higher-order sliding modes, differentiation and output-feedback control",
        {"journal": "International Journal of Control", "volume": "76", "number": "9--10", "pages": "924--941"},
    ),
    Work(
        ("Koch, Stefan", "Reichhartinger, Markus", "Horn, Martin", "Fridman, Leonid"),
        2020,
        "Discrete-time implementation of homogeneous differentiators",
        {"journal": TAC, "volume": "65", "number": "2", "pages": "757--762"},
    ),
    Work(
        ("Savitzky, Abraham", "Golay, Marcel J. E."),
        1964,
        "Smoothing and differentiation of data by simplified least squares procedures",
        {"journal": "Analytical Chemistry", "volume": "36", "number": "8", "pages": "1627--1639"},
    ),
    Work(
        ("Singer, Robert A.",),
        1970,
        "Estimating optimal tracking filter performance for manned maneuvering targets",
        {"journal": AES, "volume": "6", "number": "4", "pages": "473--483"},
    ),
    Work(
        ("Bar-Shalom, Yaakov", "Li, X. Rong", "Kirubarajan, Thiagalingam"),
        2001,
        "Estimation with applications to tracking and navigation",
        {"publisher": "Wiley"},
    ),
    Work(
        ("Salcudean, S.",),
        1991,
        "A globally convergent angular velocity observer for rigid body motion",
        {"journal": TAC, "volume": "36", "number": "12", "pages": "1493--1497"},
    ),
)
"""Every work that `source` of an observer in the registry names."""


def works_in(text: str) -> list[Work]:
    """The works that a text names by their labels.

    Args:
        text: A text, such as `source` of an observer in the registry.

    Returns:
        The works, in the order of the text.
    """
    named = [(text.find(work.label), work) for work in WORKS]
    return [work for place, work in sorted(named, key=lambda pair: pair[0]) if place >= 0]
