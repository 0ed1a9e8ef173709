/* SPDX-License-Identifier: MIT-0
   peak.h - the multiply-add peak of the processor, measured, and nets without a dead unit. Include it after common.h. */
#ifndef DIST_BENCH_PEAK_H
#define DIST_BENCH_PEAK_H

#include <time.h>

/* ---- the peak: independent chains of x * m + a ------------------------------------------------------------------- */

#if !defined(DIST_NO_SIMD) && defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
#define PEAK_X86
#include <immintrin.h>
#define TARGET(isa) __attribute__((target(isa)))
#endif
#if !defined(DIST_NO_SIMD) && defined(__aarch64__)
#define PEAK_NEON
#include <arm_neon.h>
#endif

/* Chains, so many that neither latency nor the number of registers is the limit. */
#define CHAINS12(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7) DO(8) DO(9) DO(10) DO(11)
#define CHAINS16(DO) CHAINS12(DO) DO(12) DO(13) DO(14) DO(15)
#define CHAINS24(DO) CHAINS16(DO) DO(16) DO(17) DO(18) DO(19) DO(20) DO(21) DO(22) DO(23)

#ifdef PEAK_X86
#define PEAK(NAME, ATTRIBUTE, TYPE, SET, STORE, LANES, CHAINS, COUNT, DECLARE, STEP, SUM)   \
    ATTRIBUTE static double NAME(long loops, float *sink)                      \
    {                                                                                    \
        float out[LANES];                                                                \
        TYPE m = SET(0.999f), a = SET(0.001f), sum = a;                                  \
        CHAINS(DECLARE)                                                                  \
        for (long i = 0; i < loops; i++) {                                               \
            CHAINS(STEP)                                                                 \
        }                                                                                \
        CHAINS(SUM)                                                                      \
        STORE(out, sum);                                                                 \
        *sink += out[0];                                                                 \
        return 2.0 * (LANES) * (COUNT) * (double)loops;                                  \
    }

#define DECLARE_128(i) __m128 x##i = _mm_set1_ps(0.01f * (i));
#define STEP_SS(i) x##i = _mm_add_ss(_mm_mul_ss(x##i, m), a);
#define SUM_SS(i) sum = _mm_add_ss(sum, x##i);
#define STEP_128(i) x##i = _mm_add_ps(_mm_mul_ps(x##i, m), a);
#define SUM_128(i) sum = _mm_add_ps(sum, x##i);
#define DECLARE_256(i) __m256 x##i = _mm256_set1_ps(0.01f * (i));
#define STEP_256(i) x##i = _mm256_fmadd_ps(x##i, m, a);
#define SUM_256(i) sum = _mm256_add_ps(sum, x##i);
#define DECLARE_512(i) __m512 x##i = _mm512_set1_ps(0.01f * (i));
#define STEP_512(i) x##i = _mm512_fmadd_ps(x##i, m, a);
#define SUM_512(i) sum = _mm512_add_ps(sum, x##i);
#define NO_TARGET
PEAK(peak_scalar, NO_TARGET, __m128, _mm_set_ss, _mm_store_ss, 1, CHAINS12, 12, DECLARE_128, STEP_SS, SUM_SS)
PEAK(peak_sse2, NO_TARGET, __m128, _mm_set1_ps, _mm_storeu_ps, 4, CHAINS12, 12, DECLARE_128, STEP_128, SUM_128)
PEAK(peak_avx2, TARGET("avx2,fma"), __m256, _mm256_set1_ps, _mm256_storeu_ps, 8, CHAINS12, 12, DECLARE_256,
     STEP_256, SUM_256)
/* More chains than 12 clang 14 spills. */
PEAK(peak_avx512, TARGET("avx512f"), __m512, _mm512_set1_ps, _mm512_storeu_ps, 16, CHAINS12, 12, DECLARE_512, STEP_512,
     SUM_512)
#ifdef DISTI_HALF
/* 16 bits: a vector of 32 f16 products, or 16 sums of two bf16 products each, in one instruction. */
#define SET_HALF(x) _mm512_castsi512_ps(_mm512_set1_epi32((x) > 0.5f ? 0x3bff3bff : 0x14001400))
#define DECLARE_HALF(i) __m512 x##i = _mm512_castsi512_ps(_mm512_set1_epi32(0x14001400 + (i)));
#define STEP_F16(i) __asm__("vfmadd213ph %2, %1, %0" : "+v"(x##i) : "v"(m), "v"(a));
#define STEP_BF16(i) __asm__("vdpbf16ps %2, %1, %0" : "+v"(x##i) : "v"(m), "v"(a));
PEAK(peak_f16, TARGET("avx512f,avx512fp16"), __m512, SET_HALF, _mm512_storeu_ps, 32, CHAINS24, 24, DECLARE_HALF,
     STEP_F16, SUM_512)
PEAK(peak_bf16, TARGET("avx512f,avx512bf16"), __m512, SET_HALF, _mm512_storeu_ps, 32, CHAINS24, 24, DECLARE_HALF,
     STEP_BF16, SUM_512)
#endif
#undef TARGET
#else
/* Without intrinsics the chains are plain C; volatile constants keep the compiler from working ahead. */
static double peak_scalar(long loops, float *sink)
{
    volatile float constants[2] = {0.999f, 0.001f};
    float m = constants[0];
    float a = constants[1];
    float sum = 0.0f;
#define DECLARE_1(i) float x##i = 0.01f * (i);
#define STEP_1(i) x##i = x##i * m + a;
#define SUM_1(i) sum += x##i;
    CHAINS12(DECLARE_1)
    for (long i = 0; i < loops; i++) {
        CHAINS12(STEP_1)
    }
    CHAINS12(SUM_1)
    *sink += sum;
    return 2.0 * 12 * (double)loops;
}
#endif
#ifdef PEAK_NEON
static double peak_neon(long loops, float *sink)
{
    float32x4_t m = vdupq_n_f32(0.999f);
    float32x4_t a = vdupq_n_f32(0.001f);
    float32x4_t sum = a;
#define DECLARE_NEON(i) float32x4_t x##i = vdupq_n_f32(0.01f * (i));
#define STEP_NEON(i) x##i = vfmaq_f32(a, x##i, m);
#define SUM_NEON(i) sum = vaddq_f32(sum, x##i);
    CHAINS24(DECLARE_NEON)
    for (long i = 0; i < loops; i++) {
        CHAINS24(STEP_NEON)
    }
    CHAINS24(SUM_NEON)
    *sink += vgetq_lane_f32(sum, 0);
    return 2.0 * 4 * 24 * (double)loops;
}
#endif

static inline double peak_loop(int isa, int half, long loops, float *sink)
{
#ifdef DISTI_HALF
    if (half == DIST_HALF_F16) { return peak_f16(loops, sink); }
    if (half == DIST_HALF_BF16) { return peak_bf16(loops, sink); }
#endif
    (void)half;
#ifdef PEAK_X86
    if (isa == DIST_ISA_SSE2) { return peak_sse2(loops, sink); }
    if (isa == DIST_ISA_AVX2) { return peak_avx2(loops, sink); }
    if (isa == DIST_ISA_AVX512) { return peak_avx512(loops, sink); }
#endif
#ifdef PEAK_NEON
    if (isa == DIST_ISA_NEON) { return peak_neon(loops, sink); }
#endif
    (void)isa;
    return peak_scalar(loops, sink);
}

typedef struct peak_job {
    int isa, half;
    long loops;
    double operations[64];
    float sink[64];
} peak_job;

static inline void peak_task(void *arg, int index, int worker)
{
    peak_job *job = (peak_job *)arg;
    (void)worker;
    job->operations[index] = peak_loop(job->isa, job->half, job->loops, &job->sink[index]);
}

/* One thread is timed by its processor time, which other programs disturb least; several by the clock. */
static inline double now_of(const dist_context *ctx)
{
    return dist_context_workers(ctx) == 1 ? (double)clock() / (double)CLOCKS_PER_SEC : seconds_now();
}

/* GFLOP/s of all workers together, once; *taken gets the seconds. half: of DIST_HALF_F16 or BF16; 0: in f32. */
static inline double peak_half(dist_context *ctx, int half, long loops, double *taken)
{
    static volatile float keep;
    peak_job job;
    int workers = dist_context_workers(ctx) < 64 ? dist_context_workers(ctx) : 64;
    double sum = 0;
    memset(&job, 0, sizeof job);
    job.isa = dist_context_isa(ctx);
    job.half = half;
    job.loops = loops;
    double start = now_of(ctx);
    disti_run(ctx, workers, peak_task, &job);
    *taken = now_of(ctx) - start;
    for (int i = 0; i < workers; i++) {
        sum += job.operations[i];
        keep = keep + job.sink[i];
    }
    return sum / (*taken + 1e-9) * 1e-9;
}

static inline double peak_once(dist_context *ctx, long loops, double *taken)
{
    return peak_half(ctx, DIST_HALF_OFF, loops, taken);
}

/* ---- a net that asks for all of it ------------------------------------------------------------------------------- */

/* Biases of 1 and weights so small that no unit can reach 0. */
static inline void make_alive(dist_context *ctx, dist_net *net)
{
    size_t n = dist_net_weight_count(net);
    float *weights = take_floats(n);
    memcpy(weights, dist_net_weights(net), n * sizeof *weights);
    for (int l = 0; l + 1 < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        float largest = 1.0f / sqrtf((float)layer->in); /* of PyTorch's start */
        for (size_t i = 0; i < (size_t)layer->in * (size_t)layer->out; i++) {
            weights[layer->weight + i] *= 0.4f / ((float)layer->in * largest);
        }
        for (size_t i = 0; i < (size_t)layer->out; i++) {
            weights[layer->bias + i] = 1.0f;
        }
    }
    dist_net_set_weights(ctx, net, weights);
    check(ctx);
    free(weights);
}

#endif
