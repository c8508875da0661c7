// One hidden layer with batch normalisation and ReLU on a minibatch, and its derivative: `_forward` and `_backward` of
// normalised_layer.py, each in one call, in single precision.
//
//   y (d, b) = W₂ max(γ ĥ + β, 0) + b₂,  ĥ (h, b) = W₁ z̃ / √(mean (W₁ z̃)² + ε),  z̃ (m, b) = z less its row means.
//
// Hidden units lie along the vectors and samples along the rows, so that means over a minibatch need no sum within a
// vector, and two vectors of units are taken at a time: what they need stays in the first cache. The order of all sums
// depends on the sizes alone, so that a lane of a sweep is the same run alone. h is a multiple of V, and b at least V,
// which the caller sees to, as to all shapes.

#include <cmath>
#include <cstring>
#include <utility>
#include <vector>

#include "vectors.h"

namespace {

constexpr int ACCUMULATORS = V == 16 ? 20 : 12;  // vectors that a tile keeps in registers

#define UNROLL _Pragma("GCC unroll 16")

INLINE Vec relu(Vec v) { return v <= 0 ? Vec{} : v; }  // NaN stays

struct Left { const float* at; int64_t row, step; };  // x[r, k] is at[r row + k step]
struct Right { const float* at; int64_t row; };  // y[k, n] is at[k row + n]

// Σ_k x[r, k] y[k, n] for R rows and N vectors of columns; each is handed to finish(row, column, sum).
template <int R, int N, class Finish>
INLINE void tile(Left x, Right y, int64_t depth, int64_t row, int64_t column, Finish finish) {
  Vec sum[R][N] = {};
  const float *left = x.at + row * x.row, *right = y.at + column;
  for (int64_t k = 0; k < depth; ++k, left += x.step, right += y.row) {
    Vec loaded[N];
    UNROLL for (int n = 0; n < N; ++n) loaded[n] = load(right + n * V);
    UNROLL for (int r = 0; r < R; ++r) {
      const float factor = left[r * x.row];
      UNROLL for (int n = 0; n < N; ++n) sum[r][n] += factor * loaded[n];
    }
  }
  UNROLL for (int r = 0; r < R; ++r)
    UNROLL for (int n = 0; n < N; ++n) finish(row + r, column + n * V, sum[r][n]);
}

// A tile of at most R rows.
template <int R, int N, class Finish>
INLINE void up_to(int64_t rows, Left x, Right y, int64_t depth, int64_t row, int64_t column, Finish finish) {
  if (rows == R) return tile<R, N>(x, y, depth, row, column, finish);
  if constexpr (R > 1) up_to<R - 1, N>(rows, x, y, depth, row, column, finish);
}

// The same for all rows, in tiles of about equal height.
template <int N, class Finish>
INLINE void strip(Left x, Right y, int64_t rows, int64_t depth, int64_t column, Finish finish) {
  constexpr int most = std::min(ACCUMULATORS / N, 10);
  const int64_t tiles = (rows + most - 1) / most;
  for (int64_t i = 0; i < tiles; ++i) {
    const int64_t row = rows * i / tiles;
    up_to<most, N>(rows * (i + 1) / tiles - row, x, y, depth, row, column, finish);
  }
}

template <class Finish>
INLINE void product(Left x, Right y, int64_t rows, int64_t depth, int64_t columns, Finish finish) {
  int64_t column = 0;
  for (; column + V < columns; column += 2 * V) strip<2>(x, y, rows, depth, column, finish);
  if (column < columns) strip<1>(x, y, rows, depth, column, finish);
}

// Transposes V rows by exchanging blocks of W × W, 2W × 2W, …
template <int W>
INLINE void exchange(Vec (&rows)[V]) {
  if constexpr (W < V) {
    for (int i = 0; i < V; ++i) {
      if (i & W) continue;
      Places low, high;
      for (int j = 0; j < V; ++j) low[j] = j & W ? V + j - W : j, high[j] = low[j] + W;
      const Vec a = rows[i], b = rows[i + W];
      rows[i] = __builtin_shuffle(a, b, low);
      rows[i + W] = __builtin_shuffle(a, b, high);
    }
    exchange<2 * W>(rows);
  }
}

// to[j, i] = from[i, j]. Where there are fewer than V rows or columns, V are read and written nevertheless.
void transpose(const float* from, int64_t from_row, float* to, int64_t to_row, int64_t rows, int64_t columns) {
  for (int64_t i = 0; i < rows; i += V)
    for (int64_t j = 0; j < columns; j += V) {
      const int64_t top = first(i, rows), left = first(j, columns);
      Vec block[V];
      for (int k = 0; k < V; ++k) block[k] = top + k < rows ? load(from + (top + k) * from_row + left) : Vec{};
      exchange<1>(block);
      for (int k = 0; k < V && left + k < columns; ++k) store(to + (left + k) * to_row + top, block[k]);
    }
}

float sum(const float* row, int64_t n) {
  Vec all{};
  int64_t i = 0;
  for (; i + V <= n; i += V) all += load(row + i);
  all += without(load(row + n - V), i + V - n);  // what is left, at the end of a vector
  return sum(all);
}

// Each row less its mean.
void centre(const float* from, float* to, int64_t rows, int64_t n) {
  for (int64_t r = 0; r < rows; ++r, from += n, to += n) {
    const float mean = sum(from, n) / float(n);
    for (int64_t i = 0; i < n; i += V) store(to + first(i, n), load(from + first(i, n)) - mean);
  }
}

// Sizes of a lane, the lanes of a sweep, which are the axes before, and where the arrays of a lane begin.
struct Sizes {
  int64_t m, b, h, d, M, D, lanes;
  Sizes(const Array& w1, const Array& w2, const Array& columns) : b(columns.dimensions().back()) {
    const auto in = w1.dimensions(), out = w2.dimensions();
    m = in[in.size() - 1], h = in[in.size() - 2], d = out[out.size() - 2];
    M = (m + V - 1) / V * V, D = (d + V - 1) / V * V, lanes = w1.element_count() / (m * h);
  }
  float* of(const Array& all, int64_t lane) const { return all.typed_data() + lane * all.element_count() / lanes; }
  float* of(Result& all, int64_t lane) const { return of(*all, lane); }
};

// Memory of this thread, with room for a vector behind it: calls come eighty times a step.
float* scratch(int part, int64_t n) {
  thread_local std::vector<float> parts[7];
  if (int64_t(parts[part].size()) < n + V) parts[part].resize(n + V);
  return parts[part].data();
}

// W₁ with room for a vector behind it, and W₁ᵀ.
std::pair<float*, float*> first_layer(const Sizes& s, const float* w1) {
  float *copy = scratch(0, s.h * s.m), *transposed = scratch(1, s.m * s.h);
  std::memcpy(copy, w1, s.h * s.m * sizeof(float));
  transpose(copy, s.m, transposed, s.h, s.h, s.m);
  return {copy, transposed};
}

// Calls layer.units<2>(i) for two vectors of hidden units from i on, and <1> for a last one.
template <class Layer>
void all_units(const Layer& layer) {
  int64_t i = 0;
  for (; i + V < layer.s.h; i += 2 * V) layer.template units<2>(i);
  if (i < layer.s.h) layer.template units<1>(i);
}

struct Forward {
  const Sizes& s;
  float epsilon;
  const float *gain, *shift, *bias, *centred, *w1t, *w2t;
  float *hidden, *inverse, *y;

  template <int N>
  void units(int64_t i) const {
    constexpr int64_t W = N * V;
    Vec squares[N] = {}, scale[N], move[N];
    strip<N>({centred, 1, s.b}, {w1t + i, s.h}, s.b, s.m, 0, [&](int64_t r, int64_t c, Vec v) {
      store(hidden + r * W + c, v);
      squares[c / V] += v * v;
    });
    for (int n = 0; n < N; ++n) {
      float* root = inverse + i + n * V;
      for (int j = 0; j < V; ++j) root[j] = 1 / std::sqrt(squares[n][j] / float(s.b) + epsilon);
      scale[n] = load(root) * load(gain + i + n * V);
      move[n] = load(shift + i + n * V);
    }
    for (int64_t j = 0; j < s.b; ++j)
      for (int n = 0; n < N; ++n) {
        float* at = hidden + j * W + n * V;
        store(at, relu(scale[n] * load(at) + move[n]));
      }
    product({hidden, W, 1}, {w2t + i * s.D, s.D}, s.b, W, s.D, [&](int64_t r, int64_t c, Vec v) {
      float* at = y + r * s.D + c;
      store(at, v + (i ? load(at) : load(bias + c)));
    });
  }
};

// `kept` is z̃, and behind it 1 / √(mean (W₁ z̃)² + ε).
ffi::Error forward_call(float epsilon, Array w1, Array gain, Array shift, Array w2, Array b2, Array z, Result out,
                        Result kept) {
  const Sizes s(w1, w2, z);
  float *bias = scratch(2, s.D), *w2t = scratch(3, s.h * s.D), *hidden = scratch(4, 2 * V * s.b);
  float* y = scratch(5, s.b * s.D);
  for (int64_t lane = 0; lane < s.lanes; ++lane) {
    const auto [weight, w1t] = first_layer(s, s.of(w1, lane));
    float* centred = s.of(kept, lane);
    centre(s.of(z, lane), centred, s.m, s.b);
    std::memcpy(bias, s.of(b2, lane), s.d * sizeof(float));
    transpose(s.of(w2, lane), s.h, w2t, s.D, s.d, s.h);
    all_units(Forward{s, epsilon, s.of(gain, lane), s.of(shift, lane), bias, centred, w1t, w2t, hidden,
                      centred + s.m * s.b, y});
    transpose(y, s.D, s.of(out, lane), s.b, s.b, s.d);
  }
  return ffi::Error::Success();
}

struct Backward {
  const Sizes& s;
  const float *w1, *w1t, *w2, *gain, *shift, *centred, *inverse, *d_out;
  float *hidden, *active, *d_gain, *d_shift, *d_w1t, *d_w2, *d_zt;

  template <int N>
  void units(int64_t i) const {
    constexpr int64_t W = N * V;
    Vec scale[N], move[N], by_scale[N] = {}, by_shift[N] = {};
    for (int n = 0; n < N; ++n) {
      scale[n] = load(inverse + i + n * V) * load(gain + i + n * V);
      move[n] = load(shift + i + n * V);
    }
    // The hidden units again: that takes less than to keep them for forty evaluations.
    strip<N>({centred, 1, s.b}, {w1t + i, s.h}, s.b, s.m, 0, [&](int64_t r, int64_t c, Vec v) {
      store(hidden + r * W + c, v);
      store(active + r * W + c, relu(scale[c / V] * v + move[c / V]));
    });
    strip<N>({d_out, s.b, 1}, {active, W}, s.d, s.b, 0,
             [&](int64_t r, int64_t c, Vec v) { store(d_w2 + r * s.h + i + c, v); });
    // From here `active` holds the derivative with respect to the units before the activation.
    strip<N>({d_out, 1, s.b}, {w2 + i, s.h}, s.b, s.d, 0, [&](int64_t r, int64_t c, Vec v) {
      float* at = active + r * W + c;
      v = load(at) > 0 ? v : Vec{};
      store(at, v);
      by_scale[c / V] += v * load(hidden + r * W + c);
      by_shift[c / V] += v;
    });
    for (int n = 0; n < N; ++n) {
      const Vec root = load(inverse + i + n * V);
      store(d_gain + i + n * V, by_scale[n] * root);
      store(d_shift + i + n * V, by_shift[n]);
      // Through 1 / √(mean h² + ε); and less the mean, as ∂z is: that of h is zero.
      by_scale[n] *= -load(gain + i + n * V) * root * root * root / float(s.b);
      by_shift[n] *= scale[n] / float(s.b);
    }
    for (int64_t j = 0; j < s.b; ++j)
      for (int n = 0; n < N; ++n) {
        const int64_t at = j * W + n * V;
        store(active + at, scale[n] * load(active + at) + (by_scale[n] * load(hidden + at) - by_shift[n]));
      }
    strip<N>({centred, s.b, 1}, {active, W}, s.m, s.b, 0,
             [&](int64_t r, int64_t c, Vec v) { store(d_w1t + r * s.h + i + c, v); });
    product({active, W, 1}, {w1 + i * s.m, s.m}, s.b, W, s.M, [&](int64_t r, int64_t c, Vec v) {
      float* at = d_zt + r * s.M + c;
      store(at, i ? load(at) + v : v);
    });
  }
};

ffi::Error backward_call(Array w1, Array gain, Array shift, Array w2, Array kept, Array d_out, Result d_w1,
                         Result d_gain, Result d_shift, Result d_w2, Result d_b2, Result d_z) {
  const Sizes s(w1, w2, d_out);
  float *hidden = scratch(2, 2 * V * s.b), *active = scratch(3, 2 * V * s.b), *d_w1t = scratch(4, s.m * s.h);
  float *d_zt = scratch(5, s.b * s.M), *rows = scratch(6, s.h * s.m);
  for (int64_t lane = 0; lane < s.lanes; ++lane) {
    const auto [weight, w1t] = first_layer(s, s.of(w1, lane));
    const float *centred = s.of(kept, lane), *d_y = s.of(d_out, lane);
    all_units(Backward{s, weight, w1t, s.of(w2, lane), s.of(gain, lane), s.of(shift, lane), centred,
                       centred + s.m * s.b, d_y, hidden, active, s.of(d_gain, lane), s.of(d_shift, lane), d_w1t,
                       s.of(d_w2, lane), d_zt});
    for (int64_t r = 0; r < s.d; ++r) s.of(d_b2, lane)[r] = sum(d_y + r * s.b, s.b);
    transpose(d_w1t, s.h, rows, s.m, s.m, s.h);
    std::memcpy(s.of(d_w1, lane), rows, s.h * s.m * sizeof(float));
    transpose(d_zt, s.M, s.of(d_z, lane), s.b, s.b, s.m);
  }
  return ffi::Error::Success();
}

}  // namespace

#define SIX(KIND) .KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>()
XLA_FFI_DEFINE_HANDLER_SYMBOL(normalised_layer_forward, forward_call,
                              ffi::Ffi::Bind().Attr<float>("epsilon") SIX(Arg).Ret<Array>().Ret<Array>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(normalised_layer_backward, backward_call, ffi::Ffi::Bind() SIX(Arg) SIX(Ret));
