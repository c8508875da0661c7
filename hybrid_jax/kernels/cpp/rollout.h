// The trajectories of many windows by RK4, and their derivative, in one call each way, of a field that generated code
// evaluates for V windows at a time. Defined before this file is included (source.py):
//
//   D, M, P: numbers of x, of u and of weights; F: of factors of a vector of windows whose products are derivatives.
//   slope: from w, x, u, n to ẋ; slope_back, its derivative, which `products` completes.
//   Z, H: numbers of z and of n, or 0, of the layer that couples the windows by batch normalisation,
//   n = γ q h + β with h = W (z − mean z) and q = 1 / √(mean h² + ε); W, γ and β are at WEIGHT, GAIN and SHIFT of w.
//   read: from w, x, u to z; read_back.
//
// A group of vectors of windows goes through all intervals before the next begins: one, or all if they are coupled.

#pragma once

#include "arrays.h"
#include "samples.h"

namespace {

constexpr int STAGES = 4;
constexpr int UNITS = 8;  // of the layer at a time
constexpr int64_t SLOTS = 16;  // of factors, which wait for their products
constexpr int64_t U = H ? H | 1 : 0;  // vectors from one n to the next: an even number may put all into the same lines of the cache

// What each stage's slope counts for in the step, and how far along it the next point lies.
struct Stages {
  float share[STAGES], ahead[STAGES];
  explicit Stages(float dt) : share{dt / 6, dt / 3, dt / 3, dt / 6}, ahead{dt / 2, dt / 2, dt, 0} {}
};

// An array (t, rows, count) of windows.
struct Windows {
  float* at;
  int64_t rows, count;

  // V windows from s on. Behind the last come copies of it, or zeros.
  void gather(int64_t t, int64_t s, bool zeros, Vec* to) const {
    const float* from = at + t * rows * count;
    for (int64_t r = 0; r < rows; ++r, from += count) {
      if (s + V <= count) { to[r] = load(from + s); continue; }
      for (int j = 0; j < V; ++j) to[r][j] = zeros && s + j >= count ? 0 : from[std::min(s + j, count - 1)];
    }
  }
  void scatter(const Vec* from, int64_t t, int64_t s) const {
    float* to = at + t * rows * count;
    for (int64_t r = 0; r < rows; ++r, to += count) {
      if (s + V <= count) { store(to + s, from[r]); continue; }
      for (int j = 0; j < V && s + j < count; ++j) to[s + j] = from[r][j];
    }
  }
};

// A lane: b windows of `steps` intervals, and what is kept of each evaluation for the way back, or nothing: x, h and q.
struct Lane {
  int64_t steps, b;
  float dt, epsilon;
  const float* w;
  Windows x0, u, states;
  Vec* kept;
  Room& room;

  int64_t blocks() const { return (b + V - 1) / V; }
  int64_t group() const { return H ? blocks() : 1; }  // vectors of windows
  int64_t size() const { return group() * (D + U) + (H + V - 1) / V; }  // of what is kept of an evaluation
  Vec* point(int64_t first, int64_t t, int stage) const { return kept + ((first * steps + t) * STAGES + stage) * size(); }
  Vec* h(Vec* point) const { return point + group() * D; }
  float* q(Vec* point) const { return reinterpret_cast<float*>(h(point) + group() * U); }
};

// The layer that couples all windows of a lane: z less its mean, n of a block of windows, and the derivatives.
struct Coupling {
  const Lane& lane;
  const int64_t blocks = lane.group();
  Vec *z = lane.room(blocks * Z), *dz = lane.room(blocks * Z), *n = lane.room(U), *dn = lane.room(blocks * U);
  float* scale = reinterpret_cast<float*>(lane.room(U));

  void centre(Vec* z) const {
    const int64_t last = lane.b - (blocks - 1) * V;
    for (int r = 0; r < Z; ++r) {
      Vec all{}, &end = z[(blocks - 1) * Z + r];
      end = first(end, last);
      for (int64_t j = 0; j < blocks; ++j) all += z[j * Z + r];
      const float mean = sum(all) / float(lane.b);
      for (int64_t j = 0; j < blocks; ++j) z[j * Z + r] -= mean;
      end = first(end, last);
    }
  }
  // z, and unless these are known h and q, some units at a time, so that these stay in the first cache.
  void evaluate(const Vec* x, const Vec* u, Vec* h, float* q, bool known) const {
    for (int64_t j = 0; j < blocks; ++j) read(lane.w, x + j * D, u + j * M, z + j * Z);
    centre(z);
    in_tiles<H, UNITS>([&](auto rows, int i) __attribute__((always_inline)) {
      constexpr int R = decltype(rows)::value;
      Vec squares[R] = {};
      for (int64_t j = 0; j < blocks && !known; ++j) {
        dense<R, Z>(lane.w + WEIGHT + i * Z, Z, 1, z + j * Z, h + j * U + i);
        UNROLL for (int r = 0; r < R; ++r) squares[r] += h[j * U + i + r] * h[j * U + i + r];
      }
      for (int r = 0; r < R && !known; ++r) q[i + r] = 1 / std::sqrt(sum(squares[r]) / float(lane.b) + lane.epsilon);
    });
    for (int i = 0; i < H; ++i) scale[i] = lane.w[GAIN + i] * q[i];
  }
  void normalise(const Vec* h) const {
    for (int i = 0; i < H; ++i) n[i] = scale[i] * h[i] + lane.w[SHIFT + i];
  }
  // From dn to the derivative with respect to z; adds those with respect to weights.
  void back(const Vec* h, const float* q, Vec* sums) const {
    std::fill_n(dz, blocks * Z, Vec{});
    in_tiles<H, UNITS>([&](auto rows, int i) __attribute__((always_inline)) {
      constexpr int R = decltype(rows)::value;
      Vec by_scale[R] = {}, by_shift[R] = {}, through_q[R];
      for (int64_t j = 0; j < blocks; ++j)
        UNROLL for (int r = 0; r < R; ++r) {
          const Vec d = dn[j * U + i + r];
          by_scale[r] += d * h[j * U + i + r], by_shift[r] += d;
        }
      for (int r = 0; r < R; ++r) {
        const float root = q[i + r];
        sums[GAIN + i + r] += root * by_scale[r], sums[SHIFT + i + r] += by_shift[r];
        through_q[r] = wide(-scale[i + r] * root * root * sum(by_scale[r]) / float(lane.b));
      }
      for (int64_t j = 0; j < blocks; ++j) {
        Vec* d = dn + j * U + i;
        UNROLL for (int r = 0; r < R; ++r) d[r] = scale[i + r] * d[r] + through_q[r] * h[j * U + i + r];
        dense<Z, R, true>(lane.w + WEIGHT + i * Z, 1, Z, d, dz + j * Z);
      }
      add_products<R, Z>(sums + WEIGHT + i * Z, dn + i, U, z, Z, blocks);
    });
    centre(dz);
  }
};

void forward_lane(const Lane& lane) {
  const int64_t group = lane.group(), n = group * D;
  const Stages stages(lane.dt);
  Vec *x = lane.room(n), *slopes = lane.room(n), *total = lane.room(n), *u = lane.room(group * M), *passing = lane.room(lane.size());
  const Coupling coupling{lane};
  for (int64_t first = 0; first < lane.blocks(); first += group) {
    for (int64_t j = 0; j < group; ++j) lane.x0.gather(0, (first + j) * V, false, x + j * D);
    for (int64_t t = 0; t < lane.steps; ++t) {
      for (int64_t j = 0; j < group; ++j) lane.u.gather(t, (first + j) * V, false, u + j * M);
      for (int stage = 0; stage < STAGES; ++stage) {
        Vec *point = lane.kept ? lane.point(first, t, stage) : passing, *h = lane.h(point);
        for (int64_t i = 0; i < n; ++i) point[i] = stage ? x[i] + stages.ahead[stage - 1] * slopes[i] : x[i];
        if (H) coupling.evaluate(point, u, h, lane.q(point), false);
        for (int64_t j = 0; j < group; ++j) {
          coupling.normalise(h + j * U);
          slope(lane.w, point + j * D, u + j * M, coupling.n, slopes + j * D);
        }
        for (int64_t i = 0; i < n; ++i) total[i] = (stage ? total[i] : x[i]) + stages.share[stage] * slopes[i];
      }
      std::swap(x, total);
      for (int64_t j = 0; j < group; ++j) lane.states.scatter(x + j * D, t, (first + j) * V);
    }
  }
}

#if TRAINING

// Derivatives with respect to weights, summed over windows within each place of a vector.
struct Weights {
  Vec *sums, *factors;
  int64_t used = 0;
  explicit Weights(Room& room) : sums(room(P)), factors(room(F * SLOTS)) { std::fill_n(sums, P, Vec{}); }

  Vec* next() {
    if (used == SLOTS) flush();
    return factors + F * used++;
  }
  void flush() { products(sums, factors, used), used = 0; }
};

// The derivatives with respect to points of a group, from those with respect to slopes; adds those to inputs and weights.
void evaluate_back(const Coupling& c, const float* back, Vec* point, const Vec* u, const Vec* d_slope, Weights& weights,
                   Vec* d_point, Vec* d_u) {
  HELD Vec dx[D + 1], du[M + 1];
  Vec* h = c.lane.h(point);
  float* q = c.lane.q(point);
  if (H) c.evaluate(point, u, h, q, true);
  for (int64_t j = 0; j < c.blocks; ++j) {
    c.normalise(h + j * U);
    slope_back(back, point + j * D, u + j * M, c.n, d_slope + j * D, d_point + j * D, du, c.dn + j * U, {weights.sums}, weights.next());
    for (int i = 0; i < M; ++i) d_u[j * M + i] += du[i];
  }
  if (H) c.back(h, q, weights.sums);
  for (int64_t j = 0; j < c.blocks && H; ++j) {
    read_back(back, point + j * D, u + j * M, c.dz + j * Z, dx, du, {weights.sums});
    for (int i = 0; i < D; ++i) d_point[j * D + i] += dx[i];
    for (int i = 0; i < M; ++i) d_u[j * M + i] += du[i];
  }
}

void backward_lane(const Lane& lane, const float* back, const Windows& d_states, const Windows& d_x0, const Windows& d_u, float* d_w) {
  const int64_t group = lane.group(), n = group * D;
  const Stages stages(lane.dt);
  Vec *dx = lane.room(n), *next = lane.room(n), *d_slope = lane.room(n), *d_point = lane.room(n);
  Vec *u = lane.room(group * M), *du = lane.room(group * M), *more = lane.room(D);
  const Coupling coupling{lane};
  Weights weights(lane.room);
  for (int64_t first = 0; first < lane.blocks(); first += group) {
    std::fill_n(dx, n, Vec{});
    for (int64_t t = lane.steps; t--;) {
      for (int64_t j = 0; j < group; ++j) {
        lane.u.gather(t, (first + j) * V, false, u + j * M), d_states.gather(t, (first + j) * V, true, more);
        for (int i = 0; i < D; ++i) dx[j * D + i] += more[i];
      }
      std::copy_n(dx, n, next), std::fill_n(du, group * M, Vec{});
      for (int stage = STAGES; stage--;) {
        for (int64_t i = 0; i < n; ++i) d_slope[i] = stages.share[stage] * next[i] + (stage < STAGES - 1 ? stages.ahead[stage] * d_point[i] : Vec{});
        evaluate_back(coupling, back, lane.point(first, t, stage), u, d_slope, weights, d_point, du);
        for (int64_t i = 0; i < n; ++i) dx[i] += d_point[i];
      }
      for (int64_t j = 0; j < group; ++j) d_u.scatter(du + j * M, t, (first + j) * V);
    }
    for (int64_t j = 0; j < group; ++j) d_x0.scatter(dx + j * D, 0, (first + j) * V);
  }
  weights.flush();
  for (int64_t i = 0; i < P; ++i) d_w[i] = sum(weights.sums[i]);
}

#endif

// Arguments are the weights, x0 (d, b) and u (t, m, b); results are the states and what is kept, of no size if nothing is.
enum Argument { WEIGHTS, X0, INPUTS, BACK, KEPT, D_STATES };

Lane lane_of(const LaneOf& of, float* states, Vec* kept, Room& room) {
  const Array u = of.call.argument(INPUTS);
  const int64_t b = u.size(-1);
  return {u.size(-3), b, of.call.number(0), of.call.number(1), of.argument(WEIGHTS), {of.argument(X0), D, b},
          {of.argument(INPUTS), M, b}, {states, D, b}, kept, room};
}

void forward_call(const LaneOf& of) {
  Room room;
  forward_lane(lane_of(of, of.result(0), of.call.result(1).count() ? vectors(of.result(1)) : nullptr, room));
}
HANDLER(forward)

#if TRAINING
// Results: the derivatives with respect to the weights, x0 and u.
void backward_call(const LaneOf& of) {
  Room room;
  const Lane lane = lane_of(of, nullptr, vectors(of.argument(KEPT)), room);
  backward_lane(lane, of.argument(BACK), {of.argument(D_STATES), D, lane.b}, {of.result(X0), D, lane.b}, {of.result(INPUTS), M, lane.b}, of.result(WEIGHTS));
}
HANDLER(backward)
#endif

}  // namespace
