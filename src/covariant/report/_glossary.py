"""Explains the technical terms of a report, each in one sentence."""

import re
from collections.abc import Container

from covariant.report._estimate import BANDS, EstimateReport

_MEANINGS = {
    "Innovation": "measurement minus what the estimator expected just before it.",
    "NIS": "squared innovation over the variance that the filter expects of it (normalised innovation squared). About "
    "1 where model and noise are as described; above it, the filter trusts its model or its sensors too much.",
    "NEES": "squared error of the estimate over the variance that the filter claims (normalised estimation error "
    "squared). About 1 is expected; above it, the estimate is less accurate than its standard deviation says.",
    "RMSE": "root mean square error, after the start of the log.",
    "Lag": "time by which the estimate follows the reference, by least squares over all rows; negative where it leads.",
    "Zero-phase reference": "slope of a polynomial through the positions before and after each sample: without delay, "
    "as only a whole log allows, but smoothed, so it is no exact truth.",
    "Coasted": "predicted by the model alone, without a measurement.",
    BANDS: "two standard deviations, as the filter claims them; where model and noise are right, 5 % of the rows are "
    "outside.",
    "Autocorrelation": "correlation of innovations with those some rows later. Of a right model 95 % of the bars stay "
    "between the dashed lines; many outside at short lags show noise or a force that the model does not have.",
}
_SHOWN = {"Innovation": "innovation", "Autocorrelation": "innovation", BANDS: BANDS}
"""Panels and entries of the legend that show a term."""


def glossary(report: EstimateReport, shown: Container[str]) -> dict[str, str]:
    """Explain the terms that a report uses, in its texts or by a panel or entry of the legend that is shown."""
    texts = (report.headline, report.v_reference_label, *report.notes, *report.warnings)
    text = " ".join((*texts, *(key for row in report.rows for key in row)))
    return {
        term: meaning
        for term, meaning in _MEANINGS.items()
        if _SHOWN.get(term, "") in shown or re.search(rf"(?<!\w){term}(?!\w)", text, re.IGNORECASE)
    }
