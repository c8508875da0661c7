// Windows predicted by RK4 with a trained model, in one call: `_predict` of fields.py.
//
//   ẋ = f_p(x, u) + W₂ max(W₁ z + c, 0) + b₂, z = ([x, u] − offset) factor: a rigid body, or nothing, plus one hidden
//   layer with ReLU, or nothing.
//
// A block of windows goes through all of its intervals before the next one begins, so that it stays in the first cache.

#include "rigid_body.h"
#include "rk4.h"

namespace {

constexpr int64_t BLOCK = 64;  // windows

struct Sizes {
  int64_t windows, steps, d, r, h, m, lanes;
  Sizes(Array w1, Array x0, Array u)
      : windows(x0.size(-2)), steps(u.size(-2)), d(x0.size(-1)), r(u.size(-1)), h(w1.size(-2)), m(w1.size(-1)),
        lanes(x0.count() / (windows * d)) {}
  int64_t D() const { return (d + V - 1) / V * V; }  // numbers of ẋ in whole vectors
};

// The vector field of a lane, on b columns of x and u.
struct Field {
  const Sizes& s;
  int64_t b;
  const float *theta, *offset, *factor, *c;
  Constants constants;
  float *w1t = scratch(W1T, s.m * s.h), *w2t = scratch(W2T, s.h * s.D()), *bias = scratch(BIAS, s.D());
  float *hidden = scratch(HIDDEN, W * b), *rows = scratch(ROWS, b * s.D()), *network = scratch(NETWORK, s.d * b);
  float* z = scratch(D_Z, s.m * b);

  // Some rows of z, from those of [x, u].
  void scale(int64_t begin, int64_t end, const float* from) const {
    for (int64_t r = begin; r < end; ++r, from += b)
      for (int64_t j = 0; j < b; ++j) z[r * b + j] = (from[j] - offset[r]) * factor[r];
  }

  // ẋ at x; that part of z which is of u is there already.
  void operator()(const float* x, const float* u, float* slope) const {
    const bool has_body = constants.size > 0;
    float* from_network = has_body ? network : slope;
    if (s.h > 0) {
      scale(0, s.d, x);
      for (int64_t i = 0; i < s.h; i += W) units(i);
      transpose(rows, s.D(), from_network, b, b, s.d);
    } else {
      std::fill_n(from_network, s.d * b, 0.0f);
    }
    if (has_body) forward_columns(Body(theta, constants, x, u, b), from_network, slope);
  }

  void units(int64_t i) const {
    const int64_t D = s.D();
    float *const hidden = this->hidden, *const rows = this->rows;
    Vec shift[N];
    for (int n = 0; n < N; ++n) shift[n] = load(c + i + n * V);
    strip<N>({z, 1, b}, {w1t + i, s.h}, b, s.m, 0,
             [&](int64_t r, int64_t column, Vec v) { store(hidden + r * W + column, relu(v + shift[column / V])); });
    product({hidden, W, 1}, {w2t + i * D, D}, b, W, D, [&](int64_t r, int64_t column, Vec v) {
      float* at = rows + r * D + column;
      store(at, v + (i ? load(at) : load(bias + column)));
    });
  }
};

// to[j, i] = from[i, j], of few columns, which may be shorter than a vector.
void turn(const float* from, int64_t from_row, float* to, int64_t to_row, int64_t rows, int64_t columns) {
  for (int64_t i = 0; i < rows; ++i)
    for (int64_t j = 0; j < columns; ++j) to[j * to_row + i] = from[i * from_row + j];
}

void predict_block(const Field& field, float dt, const float* x0, const float* u, float* states) {
  const Sizes& s = field.s;
  const int64_t b = field.b, n = s.d * b;
  float *x = scratch(D_X, n), *next = scratch(SUM, n), *point = scratch(POINT, n), *held = scratch(D_U, s.r * b);
  turn(x0, s.d, x, b, b, s.d);
  for (int64_t t = 0; t < s.steps; ++t, std::swap(x, next)) {
    turn(u + t * s.r, s.steps * s.r, held, b, b, s.r);
    field.scale(s.d, s.m, held);
    rk4_step(
        n, Stages(dt), x, next, [&](int) { return point; }, [&](int, float* slope) { field(point, held, slope); });
    turn(next, b, states + t * s.d, s.steps * s.d, s.d, b);
  }
}

enum Argument { THETA, OFFSET, FACTOR, WEIGHT_IN, BIAS_IN, WEIGHT_OUT, BIAS_OUT, X0, INPUTS };

void predict_lane(const Sizes& s, const Lane& lane) {
  const Numbers numbers = lane.call.numbers();
  const int64_t b = std::min(BLOCK, s.windows);
  const Field field{s, b, lane.argument(THETA), lane.argument(OFFSET), lane.argument(FACTOR), lane.argument(BIAS_IN),
                    numbers.from(CONSTANTS)};
  float* copy = scratch(W1, s.h * s.m);  // with room for a vector behind it
  std::copy_n(lane.argument(WEIGHT_IN), s.h * s.m, copy), std::copy_n(lane.argument(BIAS_OUT), s.d, field.bias);
  transpose(copy, s.m, field.w1t, s.h, s.h, s.m);
  transpose(lane.argument(WEIGHT_OUT), s.h, field.w2t, s.D(), s.d, s.h);
  for (int64_t begin = 0; begin < s.windows; begin += b) {
    const int64_t at = std::min(begin, s.windows - b);  // the last block overlaps the one before
    predict_block(field, numbers[DT], lane.argument(X0) + at * s.d, lane.argument(INPUTS) + at * s.steps * s.r,
                  lane.result(0) + at * s.steps * s.d);
  }
}

// The result: the states.
void prediction_call(const Call& call) {
  const Sizes s(call.argument(WEIGHT_IN), call.argument(X0), call.argument(INPUTS));
  for (int64_t i = 0; i < s.lanes; ++i) predict_lane(s, {call, i, s.lanes});
}

}  // namespace

HANDLER(prediction)
