// The trajectories of many windows by RK4, and their derivative, in one call each way, of a field that generated code
// evaluates for V windows at a time. Defined before this file is included (source.py):
//
//   LAYER: whether a layer with batch normalisation couples the windows; TRAINING: whether there is a way back.
//   D, M, P: numbers of x, of u and of weights; Z, H, Y: numbers that the layer reads, its units, and what it returns.
//   slope, read: from w, x, u, y to ẋ, or to what the layer reads; slope_back, read_back: their derivatives.
//   S: of the weights so many are first whose derivatives are sums; the others' are products, of_slope_back, of_read_back.
//
// A group of vectors of windows goes through all intervals before the next begins: one, or all if a layer couples them.

#pragma once

#if LAYER
#include "layer.h"
#else
#include "products.h"
#endif
#include "samples.h"

namespace {

constexpr bool COUPLED = LAYER;
constexpr int STAGES = 4;
constexpr int64_t SLOTS = 64, SLOT = SLOTS + 1;  // factors that wait for their product; not in one set of the cache

// What each stage's slope counts for in the step, and how far along it the next point lies.
struct Stages {
  float share[STAGES], ahead[STAGES];
  explicit Stages(float dt) : share{dt / 6, dt / 3, dt / 3, dt / 6}, ahead{dt / 2, dt / 2, dt, 0} {}
};

// How the windows of an array lie: the number r of window s at interval t is at[t time + r row + s sample].
struct Windows { float* at; int64_t rows, time, row, sample, count; };

// V windows from s on. Behind the last come copies of it, or zeros.
void gather(const Windows& from, int64_t t, int64_t s, bool zeros, Vec* to) {
  const float* at = from.at + t * from.time;
  for (int64_t r = 0; r < from.rows; ++r, at += from.row) {
    if (from.sample == 1 && s + V <= from.count) { to[r] = load(at + s); continue; }
    for (int j = 0; j < V; ++j) to[r][j] = zeros && s + j >= from.count ? 0 : at[std::min(s + j, from.count - 1) * from.sample];
  }
}
void scatter(const Vec* from, int64_t t, int64_t s, const Windows& to) {
  float* at = to.at + t * to.time;
  for (int64_t r = 0; r < to.rows; ++r, at += to.row) {
    if (to.sample == 1 && s + V <= to.count) { store(at + s, from[r]); continue; }
    for (int j = 0; j < V && s + j < to.count; ++j) at[(s + j) * to.sample] = from[r][j];
  }
}

// A lane: b windows of `steps` intervals, and what an evaluation keeps for the way back: x, and y and 1/√ of the layer.
struct Lane {
  int64_t steps, b;
  float dt, epsilon;
  const float* w;
  const float *weight_in, *gain, *shift, *weight_out, *bias_out;
  Windows x0, u, states;
  float* kept;

  int64_t blocks() const { return (b + V - 1) / V; }
  int64_t group() const { return COUPLED ? blocks() : 1; }  // vectors of windows
  int64_t size() const { return group() * V * (D + Y) + H; }  // of what is kept of an evaluation
  float* point(int64_t first, int64_t t, int stage) const { return kept ? kept + ((first * steps + t) * STAGES + stage) * size() : scratch(POINT, size()); }
  float* results(float* point) const { return point + group() * V * D; }  // of the layer
  float* inverse(float* point) const { return results(point) + group() * V * Y; }
};

Vec* vectors(float* at) { return reinterpret_cast<Vec*>(at); }

#if LAYER

// The layer of a lane, whose vectors of windows it couples.
struct Network {
  const Lane& lane;
  const Layer layer{Z, lane.b, lane.group() * V, H, Y, lane.epsilon, lane.weight_in, lane.gain, lane.shift, lane.weight_out};
  const int64_t B = lane.group() * V;
  float *centred = scratch(CENTRED, Z * B), *y = scratch(RESULT, Y * B), *d_z = scratch(D_Z, Z * B);

  explicit Network(const Lane& lane) : lane(lane) {}

  void centre(Vec* x, const Vec* u) const {
    HELD Vec z[Z];
    for (int64_t j = 0; j < lane.group(); ++j) {
      read(lane.w, x + j * D, u + j * M, nullptr, z);
      for (int r = 0; r < Z; ++r) store(centred + r * B + j * V, z[r]);
    }
    ::centre(centred, Z, lane.b, B);
  }
  void forward(float* point, const Vec* u) const {
    centre(vectors(point), u);
    layer.forward(centred, lane.bias_out, lane.inverse(point), y);
    for (int r = 0; r < Y; ++r) std::fill(y + r * B + lane.b, y + (r + 1) * B, y[r * B + lane.b - 1]);
    Vec* to = vectors(lane.results(point));
    for (int64_t j = 0; j < lane.group(); ++j)
      for (int r = 0; r < Y; ++r) to[j * Y + r] = load(y + r * B + j * V);
  }
  // From the derivatives with respect to results, in `y`, to those with respect to what is read, in `d_z`.
  void backward(float* point, const Vec* u, Gradients to) const {
    centre(vectors(point), u);
    layer.backward(centred, lane.inverse(point), y, to, d_z);
    for (int r = 0; r < Z; ++r) std::fill(d_z + r * B + lane.b, d_z + (r + 1) * B, 0.0f);
  }
};

#else

struct Gradients { float *w1t, *gain, *shift, *w2, *bias; };
struct Network {
  explicit Network(const Lane&) {}
  void forward(float*, const Vec*) const {}
};

#endif

void forward_lane(const Lane& lane) {
  const int64_t group = lane.group(), n = group * D;
  const Stages stages(lane.dt);
  Vec *x = vectors(scratch(STATE, n * V)), *slopes = vectors(scratch(SLOPE, n * V)), *sum = vectors(scratch(SUM, n * V));
  Vec* u = vectors(scratch(INPUT, group * M * V));
  const Network network(lane);
  for (int64_t first = 0; first < lane.blocks(); first += group) {
    for (int64_t j = 0; j < group; ++j) gather(lane.x0, 0, (first + j) * V, false, x + j * D);
    for (int64_t t = 0; t < lane.steps; ++t) {
      for (int64_t j = 0; j < group; ++j) gather(lane.u, t, (first + j) * V, false, u + j * M);
      for (int stage = 0; stage < STAGES; ++stage) {
        float* at = lane.point(first, t, stage);
        Vec* point = vectors(at);
        for (int64_t i = 0; i < n; ++i) store(at + i * V, stage ? x[i] + stages.ahead[stage - 1] * slopes[i] : x[i]);
        network.forward(at, u);
        for (int64_t j = 0; j < group; ++j) slope(lane.w, point + j * D, u + j * M, vectors(lane.results(at)) + j * Y, slopes + j * D);
        for (int64_t i = 0; i < n; ++i) sum[i] = (stage ? sum[i] : x[i]) + stages.share[stage] * slopes[i];
      }
      std::swap(x, sum);
      for (int64_t j = 0; j < group; ++j) scatter(x + j * D, t, (first + j) * V, lane.states);
    }
  }
}

#if TRAINING

// Derivatives with respect to weights that are products of factors, which wait in slots.
struct Products {
  float* to;
  const Outer* list;
  Part part;
  int64_t used = 0;

  int64_t size() const {
    int64_t n = 0;
    for (const Outer* one = list; one->rows; ++one) n += one->rows + one->columns;
    return n;
  }
  Vec* factors() const { return vectors(scratch(part, size() * SLOT * V)); }
  Slots next() {
    if (used == SLOTS) flush();
    return {factors() + used++, SLOT};
  }
  void flush() {
    const Vec* at = factors();
    for (const Outer* one = list; one->rows; ++one) {
      const Vec* columns = at + one->rows * SLOT;
      for (int64_t i = 0; i < one->rows; i += 4)
        for (int64_t j = 0; j < one->columns; j += V / 4) tile(at, columns, i, j, *one);
      at = columns + one->columns * SLOT;
    }
    used = 0;
  }
  void tile(const Vec* rows, const Vec* columns, int64_t i, int64_t j, const Outer& one) const {
    constexpr int R = 4, C = V / 4;
    const Vec *row[R], *column[C];
    for (int r = 0; r < R; ++r) row[r] = rows + std::min<int64_t>(i + r, one.rows - 1) * SLOT;
    for (int c = 0; c < C; ++c) column[c] = columns + std::min<int64_t>(j + c, one.columns - 1) * SLOT;
    HELD Vec sum[V] = {}, all{};
    for (int64_t s = 0; s < used; ++s)
      UNROLL for (int r = 0; r < R; ++r)
        UNROLL for (int c = 0; c < C; ++c) sum[r * C + c] += row[r][s] * column[c][s];
    exchange<1>(sum);
    for (int k = 0; k < V; ++k) all += sum[k];
    for (int r = 0; r < R && i + r < one.rows; ++r)
      for (int c = 0; c < C && j + c < one.columns; ++c) to[one.place + (i + r) * one.columns + j + c] += all[r * C + c];
  }
};

// All derivatives with respect to weights.
struct Weights {
  float* to;
  Vec* sums = vectors(scratch(SUMS, S * V));
  Products of_slope{to, of_slope_back, FACTORS}, of_read{to, of_read_back, READ_FACTORS};

  explicit Weights(float* to) : to(to) { std::fill_n(to, P, 0.0f), std::fill_n(sums, S, Vec{}); }
  void finish() {
    of_slope.flush(), of_read.flush();
    for (int64_t i = 0; i < S; ++i) to[i] += sum(sums[i]);
  }
};

// The derivatives with respect to points of a group, from those with respect to slopes; adds those to inputs and weights.
void evaluate_back(const Lane& lane, const Network& network, const float* back, float* point, const Vec* u,
                   const Vec* d_slope, Weights& weights, Gradients to, Vec* d_point, Vec* d_u) {
  const Sums sums{weights.sums};
  HELD Vec dx[D + 1], du[M + 1], dy[Y + 1];
  Vec *y = vectors(lane.results(point)), *x = vectors(point);
  for (int64_t j = 0; j < lane.group(); ++j, d_slope += D, y += Y) {
    slope_back(back, x + j * D, u + j * M, y, d_slope, nullptr, d_point + j * D, du, dy, sums, weights.of_slope.next());
    for (int i = 0; i < M; ++i) d_u[j * M + i] += du[i];
#if LAYER
    for (int i = 0; i < Y; ++i) store(network.y + i * network.B + j * V, dy[i]);
  }
  network.backward(point, u, to);
  for (int64_t j = 0; j < lane.group(); ++j) {
    HELD Vec d_read[Z];
    for (int i = 0; i < Z; ++i) d_read[i] = load(network.d_z + i * network.B + j * V);
    read_back(back, x + j * D, u + j * M, nullptr, nullptr, d_read, dx, du, dy, sums, weights.of_read.next());
    for (int i = 0; i < D; ++i) d_point[j * D + i] += dx[i];
    for (int i = 0; i < M; ++i) d_u[j * M + i] += du[i];
#endif
  }
}

void backward_lane(const Lane& lane, const float* back, const Windows& d_states, const Windows& d_x0, const Windows& d_u,
                   Weights weights, Gradients to) {
  const int64_t group = lane.group(), n = group * D;
  const Stages stages(lane.dt);
  auto room = [](Part part, int64_t n) { return vectors(scratch(part, n * V)); };
  Vec *dx = room(D_X, n), *next = room(D_NEXT, n), *d_slope = room(D_SLOPE, n), *d_point = room(D_POINT, n);
  Vec *u = room(INPUT, group * M), *du = room(D_U, group * M);
  HELD Vec more[D];
  const Network network(lane);
  for (int64_t first = 0; first < lane.blocks(); first += group) {
    std::fill_n(dx, n, Vec{});
    for (int64_t t = lane.steps; t--;) {
      for (int64_t j = 0; j < group; ++j) {
        gather(lane.u, t, (first + j) * V, false, u + j * M), gather(d_states, t, (first + j) * V, true, more);
        for (int i = 0; i < D; ++i) dx[j * D + i] += more[i];
      }
      std::copy_n(dx, n, next), std::fill_n(du, group * M, Vec{});
      for (int stage = STAGES; stage--;) {
        for (int64_t i = 0; i < n; ++i) d_slope[i] = stages.share[stage] * next[i] + (stage < STAGES - 1 ? stages.ahead[stage] * d_point[i] : Vec{});
        evaluate_back(lane, network, back, lane.point(first, t, stage), u, d_slope, weights, to, d_point, du);
        for (int64_t i = 0; i < n; ++i) dx[i] += d_point[i];
      }
      for (int64_t j = 0; j < group; ++j) scatter(du + j * M, t, (first + j) * V, d_u);
    }
    for (int64_t j = 0; j < group; ++j) scatter(dx + j * D, 0, (first + j) * V, d_x0);
  }
  weights.finish();
}

#endif

// Arguments: the weights, those of the layer, x0 and u. Arrays are (d, b) and (t, m, b), or (b, d) and (b, t, m).
enum Argument { WEIGHTS, WEIGHT_IN, GAIN, SHIFT, WEIGHT_OUT, BIAS_OUT, X0, INPUTS, BACK, KEPT, D_STATES };

Windows windows(float* at, int64_t rows, int64_t steps, int64_t b, bool last) {
  return last ? Windows{at, rows, rows * b, b, 1, b} : Windows{at, rows, rows, 1, steps * rows, b};
}

struct Shape {
  int64_t steps, b, lanes;
  bool last;
  Shape(const Call& call, bool last) : last(last) {
    const Array x0 = call.argument(X0), u = call.argument(INPUTS);
    b = last ? x0.size(-1) : x0.size(-2), steps = last ? u.size(-3) : u.size(-2);
    lanes = x0.count() / (b * D);
  }
  Lane lane(const LaneOf& of, float* states, float* kept) const {
    const Numbers numbers = of.call.numbers();
    return {steps, b, numbers[0], numbers[1], of.argument(WEIGHTS), of.argument(WEIGHT_IN), of.argument(GAIN), of.argument(SHIFT),
            of.argument(WEIGHT_OUT), of.argument(BIAS_OUT), windows(of.argument(X0), D, 1, b, last), windows(of.argument(INPUTS), M, steps, b, last),
            windows(states, D, steps, b, last), kept ? aligned(kept) : kept};
  }
};

#if TRAINING
void forward_call(const Call& call) {
  const Shape shape(call, true);
  for (int64_t i = 0; i < shape.lanes; ++i) {
    const LaneOf of{call, i, shape.lanes};
    forward_lane(shape.lane(of, of.result(0), of.result(1)));
  }
}
// Results: the derivatives with respect to the arguments up to u.
void backward_call(const Call& call) {
  const Shape shape(call, true);
  float* d_w1t = scratch(D_W1T, Z * H);
  for (int64_t i = 0; i < shape.lanes; ++i) {
    const LaneOf of{call, i, shape.lanes};
    const Lane lane = shape.lane(of, nullptr, of.argument(KEPT));
    auto like = [&](int argument, float* at, int64_t rows) { return windows(at, rows, shape.steps, shape.b, true); };
    const Gradients to{d_w1t, of.result(GAIN), of.result(SHIFT), of.result(WEIGHT_OUT), of.result(BIAS_OUT)};
#if LAYER
    const Network network(lane);
    network.layer.clear(to);
#endif
    backward_lane(lane, of.argument(BACK), like(0, of.argument(D_STATES), D), like(0, of.result(X0), D), like(0, of.result(INPUTS), M),
                  Weights(of.result(WEIGHTS)), to);
#if LAYER
    network.layer.to_rows(d_w1t, of.result(WEIGHT_IN));
#endif
  }
}

HANDLER(forward)
HANDLER(backward)
#else
void predict_call(const Call& call) {
  const Shape shape(call, false);
  for (int64_t i = 0; i < shape.lanes; ++i) {
    const LaneOf of{call, i, shape.lanes};
    forward_lane(shape.lane(of, of.result(0), nullptr));
  }
}

HANDLER(predict)
#endif

}  // namespace
