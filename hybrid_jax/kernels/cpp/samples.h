// Operations on a number of each of V samples, for generated code: a `real` is such a vector, a float the same for all.

#include "vectors.h"

namespace {

using real = Vec;
using logical = Places;  // -1 where it is true; 1 in arrays

INLINE Vec wide(Vec v) { return v; }
INLINE Vec wide(float v) { return v - Vec{}; }
INLINE Vec wide(logical v) { return v ? wide(1.0f) : Vec{}; }

INLINE bool truth(float v) { return v; }
INLINE logical truth(Vec v) { return v != Vec{}; }
INLINE logical truth(logical v) { return v; }
template <class Mask, class A, class B>
INLINE Vec choose(Mask which, A a, B b) {
  return truth(which) ? wide(a) : wide(b);
}

// NaN, if one is NaN; beside a number that the compiler knows, as in ReLU, one comparison is enough.
template <class B> INLINE bool is_known(B b) { return __builtin_constant_p(b) && b == b; }
INLINE bool is_known(Vec) { return false; }
#define EXTREME(NAME, BEYOND)                                             \
  template <class A, class B> INLINE Vec NAME(A a, B b) {                 \
    const Vec l = wide(a), r = wide(b);                                   \
    return is_known(b) ? (r BEYOND l ? r : l) : (l BEYOND r) | (l != l) ? l : r; \
  }
EXTREME(larger, >) EXTREME(smaller, <)

// Of glibc's library of vectors, within four units in the last place; and number by number.
#if V == 16
#define OF_GLIBC "_ZGVeN16"
#else
#define OF_GLIBC "_ZGVdN8"
#endif
typedef float Whole __attribute__((vector_size(4 * V)));
#define OF_VECTORS(NAME, PLACES, ...)                                                   \
  extern "C" Whole of_##NAME(__VA_ARGS__) __asm__(OF_GLIBC PLACES "_" #NAME);           \
  template <class... A> INLINE Vec NAME(A... a) { return of_##NAME(wide(a)...); }
#define OF_ONE(NAME) OF_VECTORS(NAME, "v", Whole)
#define OF_TWO(NAME) OF_VECTORS(NAME, "vv", Whole, Whole)
#define EACH(NAME)                                                                      \
  template <class A, class... B> INLINE Vec NAME(A a, B... b) {                         \
    float each[V];                                                                      \
    store(each, wide(a));                                                               \
    for (int j = 0; j < V; ++j) each[j] = ::NAME(each[j], wide(b)[j]...);               \
    return load(each);                                                                  \
  }
OF_ONE(expf) OF_ONE(expm1f) OF_ONE(logf) OF_ONE(log1pf) OF_ONE(erff) OF_ONE(erfcf) OF_ONE(exp2f) OF_ONE(cbrtf)
OF_ONE(sinf) OF_ONE(cosf) OF_ONE(tanf) OF_ONE(asinf) OF_ONE(acosf) OF_ONE(atanf)
OF_ONE(sinhf) OF_ONE(coshf) OF_ONE(tanhf) OF_ONE(asinhf) OF_ONE(acoshf) OF_ONE(atanhf)
OF_TWO(atan2f) OF_TWO(powf)
EACH(sqrtf) EACH(floorf) EACH(ceilf) EACH(fabsf) EACH(fmodf)

// The result of batch normalisation, γ q h + β.
struct Normal {
  const float *scale, *shift;
  const Vec* h;
  INLINE Vec operator[](int64_t i) const { return scale[i] * h[i] + shift[i]; }
  INLINE Normal operator+(int64_t i) const { return {scale + i, shift + i, h + i}; }
};

// out = A B of M rows and N columns, with A[i, k] at a[i row + k step].
template <int M, int K, int N, class A, class B>
INLINE void product(A a, int64_t row, int64_t step, B b, Vec* out) {
  if constexpr (N == 1 && std::is_pointer_v<A>) dense<M, K>(a, row, step, b, out);
  else for (int j = 0; j < N; ++j)
    for (int i = 0; i < M; ++i) {
      Vec sum{};
      for (int l = 0; l < K; ++l) sum += a[i * row + l * step] * b[l * N + j];
      out[i * N + j] = sum;
    }
}

}  // namespace
