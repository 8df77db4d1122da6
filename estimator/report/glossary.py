"""The words of the report for people who do not measure for a living."""

TERMS: tuple[tuple[str, str], ...] = (
    (
        "GO",
        "Every limit of the cut plan is kept with at least the required probability, tool included, and nothing casts "
        "doubt on the measurement itself.",
    ),
    (
        "MEASURE MORE",
        "The place may be fine, but nobody can say so yet. Do what stands under What to do next, then ask again.",
    ),
    (
        "NO-GO",
        "No further measurement helps: the tool is too coarse for the tolerance, or the place is too near to something "
        "that must not be touched. Change the plan.",
    ),
    (
        "NO VERDICT",
        "The cut plan says nothing about this point. Without tolerances there is no permission.",
    ),
    (
        "probability of a wrong GO",
        "How often, among many such decisions, a permitted cut may miss its limits. The plan sets it; 5 % is usual.",
    ),
    (
        "tolerance along and across",
        "How far the cut may be off in the pipe's direction, and sideways from its middle. Half the blade's width is "
        "taken off the first, so that both faces of the cut stay inside.",
    ),
    (
        "standard uncertainty (u, σ)",
        "The usual size of the error. One number alone is off by more than it in one case of three.",
    ),
    (
        "expanded uncertainty (U), coverage factor (k)",
        "U = k u is the size that the error stays below in 95 % of cases. For one number k is 1.96; for a place in "
        "space, where three numbers must be right together, it is 2.80.",
    ),
    (
        "95 % ellipsoid",
        "The region that holds the true place with 95 %. It is longer where the measurement is weaker, mostly in "
        "depth.",
    ),
    (
        "95 % within a sphere",
        "The same as one number: the radius about the estimate that holds the true place with 95 %.",
    ),
    (
        "uncertainty budget",
        "Which measurement contributes how much. The squares of the contributions add up to the square of the whole.",
    ),
    (
        "reserve of uncertainty",
        "How many times as uncertain the measurement might be before the verdict changes. Below 1 it says how far the "
        "uncertainty has to come down.",
    ),
    (
        "guard band",
        "The strip inside the limits that is not used, because the truth may lie on the other side of them.",
    ),
    (
        "chi-square",
        "Sum of the squared misfits, each divided by its own uncertainty. Divided by the degrees of freedom it is near "
        "1 where the stated uncertainties are right; far above 1 something is wrong.",
    ),
    (
        "calibration, prior",
        "Properties of the cameras. The prior is what was known before the recording; the recording corrects it.",
    ),
    (
        "board",
        "The page with printed markers that ties the mobile camera to the machine. The longer ago it was seen, the "
        "less is known about whether anything has moved; after the time in the plan a permission ends.",
    ),
    (
        "validated range",
        "The conditions under which the stated uncertainty has been compared with known truth. Outside them no cut is "
        "permitted.",
    ),
    (
        "{b}",
        "The coordinate frame of the machine's depth camera: x right, y down, z forward.",
    ),
)
