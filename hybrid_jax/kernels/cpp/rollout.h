// The trajectories of many windows by RK4, and their derivative, in one call each way, of a field that generated code
// evaluates for V windows at a time. Defined before this file is included (source.py):
//
//   D, M, P: numbers of x, of u and of weights; F: of factors of a vector of windows whose products are derivatives.
//   slope: from w, x, u, n to ẋ; slope_back, its derivative, which `products` completes. u has none.
//   Z, H: numbers of z and of n, or 0, of the layer that couples the windows by batch normalisation,
//   n = γ q h + β with h = W (z − mean z) and q = 1 / √(mean h² + ε); W, γ and β are at WEIGHT, GAIN and SHIFT of w.
//   read: from w, x, u to z; read_back, which needs the derivatives with respect to the first BACK numbers of z.
//
// A group of vectors of windows goes through all intervals before the next begins: one, or all if they are coupled.

#include "xla/ffi/api/c_api.h"

namespace {

constexpr int STAGES = 4;
constexpr int UNITS = 16;  // of the layer at a time
constexpr int64_t SLOTS = 28;  // of factors, which wait for their products: those of a step of a hundred windows
constexpr int64_t U = H ? H | 1 : 0;  // vectors from one n to the next: an even number may put all into the same lines of the cache

// Arguments: the weights, x0 (d, b) and u (t, m, b), on the way back also those of the kernels there, what was kept, and
// the derivatives with respect to the states.
enum Argument { WEIGHTS, X0, INPUTS, WEIGHTS_BACK, KEPT, D_STATES };

// The vector j of windows of an array (rows, b); behind the end the last window repeats.
INLINE void gather(const float* from, int64_t rows, int64_t b, int64_t j, Vec* to) {
  for (int64_t r = 0; r < rows; ++r) to[r] = load(from + r * b + j * V, b - j * V);
}
INLINE void scatter(const Vec* from, int64_t rows, int64_t b, int64_t j, float* to) {
  for (int64_t r = 0; r < rows; ++r) store(to + r * b + j * V, from[r], b - j * V);
}

// A call of XLA with arrays in single precision; the caller in Python keeps to number and shapes. By the interface in C:
// GCC takes longer for the other than for the kernels.
INLINE const XLA_FFI_Buffer& array(const void* of) { return *static_cast<const XLA_FFI_Buffer*>(of); }
INLINE float* data(const void* of) { return static_cast<float*>(array(of).data); }

// b windows of `steps` intervals, and what is kept of each evaluation for the way back, or nothing: x, h and q.
struct Windows {
  const XLA_FFI_CallFrame* call;
  Vec* kept;
  float* argument(int i) const { return data(call->args.args[i]); }
  float* result(int i) const { return data(call->rets.rets[i]); }

  const float* numbers = static_cast<const float*>(static_cast<const XLA_FFI_Array*>(call->attrs.attrs[1])->data);
  const int64_t* shape = array(call->args.args[INPUTS]).dims;
  const int64_t steps = shape[0], b = shape[2], blocks = (b + V - 1) / V;
  const int64_t group = H ? blocks : 1, n = group * D;  // vectors of windows, and of their states
  const int64_t size = group * (D + U) + (H + V - 1) / V;  // of what is kept of an evaluation
  // What each stage's slope counts for in the step, and how far along it the next point lies.
  const float dt = numbers[0], share[STAGES] = {dt / 6, dt / 3, dt / 3, dt / 6}, ahead[STAGES] = {dt / 2, dt / 2, dt, 0};
  const float epsilon = numbers[1], *w = argument(WEIGHTS);
  float *x0 = argument(X0), *u = argument(INPUTS);
  mutable Room room{};

  Vec* point(int64_t first, int64_t t, int stage) const { return kept + ((first * steps + t) * STAGES + stage) * size; }
  Vec* h(Vec* point) const { return point + n; }
  float* q(Vec* point) const { return reinterpret_cast<float*>(h(point) + group * U); }
};

// The derivative with respect to h, kept when it is read.
struct Through {
  const float *scale, *through_q;
  const Vec *dn, *h;
  Vec* dh;
  INLINE Vec operator[](int64_t i) const { return dh[i] = scale[i] * dn[i] + through_q[i] * h[i]; }
};

// The layer that couples all windows: z less its mean, n of a block of windows, and the derivatives. z and the
// derivatives with respect to h wait for their products until a step's stages are done.
struct Coupling {
  const Windows& all;
  const int64_t blocks = all.group;
  Vec *zs = all.room(STAGES * blocks * Z), *dhs = all.room(STAGES * blocks * U), *dn = all.room(blocks * U), *dz = all.room(blocks * Z);
  float *scale = reinterpret_cast<float*>(all.room(U)), *through_q = reinterpret_cast<float*>(all.room(U));

  template <int ROWS>
  void centre(Vec* z) const {
    in_tiles<ROWS, UNITS>([&](auto rows, int i) __attribute__((always_inline)) {
      constexpr int R = decltype(rows)::value;
      Vec total[R] = {};
      for (int64_t j = 0; j < blocks; ++j)
        UNROLL for (int r = 0; r < R; ++r) total[r] += first(z[j * Z + i + r], all.b - j * V);
      UNROLL for (int r = 0; r < R; ++r) total[r] = wide(sum(total[r]) / float(all.b));
      for (int64_t j = 0; j < blocks; ++j)
        UNROLL for (int r = 0; r < R; ++r) z[j * Z + i + r] = first(z[j * Z + i + r] - total[r], all.b - j * V);
    });
  }
  // z, and unless these are known h and q, some units at a time, so that these stay in the first cache.
  void evaluate(int stage, const Vec* x, const Vec* u, Vec* h, float* q, bool known) const {
    Vec* z = zs + stage * blocks * Z;
    for (int64_t j = 0; j < blocks; ++j) read(all.w, x + j * D, u + j * M, z + j * Z);
    centre<Z>(z);
    if (!known) in_tiles<H, UNITS>([&](auto rows, int i) __attribute__((always_inline)) {
      constexpr int R = decltype(rows)::value;
      Vec squares[R] = {};
      for (int64_t j = 0; j < blocks; ++j) {
        Vec* block = h + j * U + i;
        dense<R, Z>(all.w + WEIGHT + i * Z, Z, 1, z + j * Z, block);
        UNROLL for (int r = 0; r < R; ++r) squares[r] += block[r] * block[r];
      }
      UNROLL for (int r = 0; r < R; ++r) q[i + r] = 1 / std::sqrt(sum(squares[r]) / float(all.b) + all.epsilon);
    });
    for (int i = 0; i < H; ++i) scale[i] = all.w[GAIN + i] * q[i];
  }
  Normal normal(const Vec* h) const { return {scale, all.w + SHIFT, h}; }
  // From dn to the derivatives with respect to h and z; adds those with respect to γ and β, of some units at a time.
  void back(int stage, const Vec* h, const float* q, Vec* sums) const {
    Vec* dh = dhs + stage * blocks * U;
    in_tiles<H, 8>([&](auto rows, int i) __attribute__((always_inline)) {
      constexpr int R = decltype(rows)::value;
      Vec by_scale[R] = {}, by_shift[R] = {};
      for (int64_t j = 0; j < blocks; ++j)
        UNROLL for (int r = 0; r < R; ++r) by_scale[r] += dn[j * U + i + r] * h[j * U + i + r], by_shift[r] += dn[j * U + i + r];
      UNROLL for (int r = 0; r < R; ++r) {
        sums[GAIN + i + r] += q[i + r] * by_scale[r], sums[SHIFT + i + r] += by_shift[r];
        through_q[i + r] = -scale[i + r] * q[i + r] * q[i + r] * sum(by_scale[r]) / float(all.b);
      }
    });
    for (int64_t j = 0; j < blocks; ++j)
      dense<BACK, H>(all.w + WEIGHT, 1, Z, Through{scale, through_q, dn + j * U, h + j * U, dh + j * U}, dz + j * Z);
    centre<BACK>(dz);
  }
};

}  // namespace

// Results: the states and what is kept, of no size if nothing is.
extern "C" void forward(const XLA_FFI_CallFrame* call) {
  const void* kept = call->rets.rets[1];
  const Windows all{call, array(kept).dims[0] ? vectors(data(kept)) : nullptr};
  const int64_t group = all.group, n = all.n, b = all.b;
  Vec *x = all.room(n), *slopes = all.room(n), *total = all.room(n), *u = all.room(group * M), *passing = all.room(all.size);
  const Coupling coupling{all};
  for (int64_t first = 0; first < all.blocks; first += group) {
    for (int64_t j = 0; j < group; ++j) gather(all.x0, D, b, first + j, x + j * D);
    for (int64_t t = 0; t < all.steps; ++t) {
      for (int64_t j = 0; j < group; ++j) gather(all.u + t * M * b, M, b, first + j, u + j * M);
      for (int stage = 0; stage < STAGES; ++stage) {
        Vec *point = all.kept ? all.point(first, t, stage) : passing, *h = all.h(point);
        for (int64_t i = 0; i < n; ++i) point[i] = stage ? x[i] + all.ahead[stage - 1] * slopes[i] : x[i];
        if (H) coupling.evaluate(0, point, u, h, all.q(point), false);
        for (int64_t j = 0; j < group; ++j)
          slope(all.w, point + j * D, u + j * M, coupling.normal(h + j * U), slopes + j * D);
        for (int64_t i = 0; i < n; ++i) total[i] = (stage ? total[i] : x[i]) + all.share[stage] * slopes[i];
      }
      std::swap(x, total);
      for (int64_t j = 0; j < group; ++j) scatter(x + j * D, D, b, first + j, all.result(0) + t * D * b);
    }
  }
}

#if TRAINING
// Results: the derivatives with respect to the weights and x0. Those with respect to weights are summed over windows
// within each place of a vector; their factors wait in slots for the products.
extern "C" void backward(const XLA_FFI_CallFrame* call) {
  const Windows all{call, vectors(data(call->args.args[KEPT]))};
  const int64_t group = all.group, n = all.n, b = all.b;
  const float *back = all.argument(WEIGHTS_BACK), *d_states = all.argument(D_STATES);
  Vec *dx = all.room(n), *next = all.room(n), *d_slope = all.room(n), *d_point = all.room(n);
  Vec *u = all.room(group * M), *more = all.room(D), *sums = all.room(P), *factors = all.room(F * SLOTS);
  int64_t used = 0;
  const Coupling c{all};
  std::fill_n(sums, P, Vec{});
  for (int64_t first = 0; first < all.blocks; first += group) {
    std::fill_n(dx, n, Vec{});
    for (int64_t t = all.steps; t--;) {
      for (int64_t j = 0; j < group; ++j) {
        gather(all.u + t * M * b, M, b, first + j, u + j * M), gather(d_states + t * D * b, D, b, first + j, more);
        for (int i = 0; i < D; ++i) dx[j * D + i] += ::first(more[i], b - (first + j) * V);
      }
      std::copy_n(dx, n, next);
      for (int stage = STAGES; stage--;) {
        Vec *point = all.point(first, t, stage), *h = all.h(point);
        for (int64_t i = 0; i < n; ++i) d_slope[i] = all.share[stage] * next[i] + (stage < STAGES - 1 ? all.ahead[stage] * d_point[i] : Vec{});
        if (H) c.evaluate(stage, point, u, h, all.q(point), true);
        for (int64_t j = 0; j < group; ++j) {
          if (used == SLOTS) products(sums, factors, used), used = 0;
          slope_back(back, point + j * D, u + j * M, c.normal(h + j * U), d_slope + j * D, d_point + j * D, c.dn + j * U, sums, factors + F * used++);
        }
        if (H) c.back(stage, h, all.q(point), sums);
        for (int64_t j = 0; j < group && H; ++j) {
          read_back(back, point + j * D, u + j * M, c.dz + j * Z, more, sums);
          for (int i = 0; i < D; ++i) d_point[j * D + i] += more[i];
        }
        for (int64_t i = 0; i < n; ++i) dx[i] += d_point[i];
      }
      if (H) add_products<H, Z>(sums + WEIGHT, c.dhs, U, c.zs, Z, STAGES * group);
    }
    for (int64_t j = 0; j < group; ++j) scatter(dx + j * D, D, b, first + j, all.result(X0));
  }
  products(sums, factors, used);
  for (int64_t i = 0; i < P; ++i) all.result(WEIGHTS)[i] = sum(sums[i]);
}
#endif
