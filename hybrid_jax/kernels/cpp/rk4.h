// One step of the classical Runge–Kutta method.

#pragma once

#include "products.h"

namespace {

constexpr int STAGES = 4;

// What each stage's slope counts for in the step, and how far along it the next point lies.
struct Stages {
  float share[STAGES], ahead[STAGES];
  explicit Stages(float dt) : share{dt / 6, dt / 3, dt / 3, dt / 6}, ahead{dt / 2, dt / 2, dt, 0} {}
};

// From n numbers x to `next`. `point(stage)` is where the state of a stage is put, `evaluate(stage, slope)` its slope.
template <class Point, class Evaluate>
void rk4_step(int64_t n, const Stages& stages, const float* x, float* next, Point point, Evaluate evaluate) {
  float* slope = scratch(SLOPE, n);
  for (int stage = 0; stage < STAGES; ++stage) {
    float* at = point(stage);
    for (int64_t i = 0; i < n; ++i) at[i] = stage ? x[i] + stages.ahead[stage - 1] * slope[i] : x[i];
    evaluate(stage, slope);
    for (int64_t i = 0; i < n; ++i) next[i] = (stage ? next[i] : x[i]) + stages.share[stage] * slope[i];
  }
}

}  // namespace
