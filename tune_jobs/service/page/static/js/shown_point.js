// The values to stand beside a trial's score: those that it was reached with. A population's trials go on with others.
export const shownPoint = (trial) => trial.score_point ?? trial.point;
