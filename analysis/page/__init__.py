"""The sections of a sweep's report: a module each, which makes what the template of the same name shows.

    answer       which setting and which policy to use, in two or three sentences
    cards        the policy and the setting, with the films
    how_sure     the leading settings, seed by seed, and what can't be told apart
    mattered     which hyperparameters mattered, and how
    learning     learning curves
    cost         env steps and time
    next_steps   what to do next, to copy
    all_trials   every trial, and those that failed with their causes (templates trials and failures)
    repeat       how to repeat it

Each has a function `section` of a `source.Source`, which returns a dataclass that the template knows by the section's
name. Figures are added to a section by its name too (`figures.pictures`).
"""
