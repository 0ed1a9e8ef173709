/* SPDX-License-Identifier: MIT-0
   scheduler.c - the library's work on a thread pool of yours, beside OpenMP's: the same bits, and both speeds.
   make build/scheduler && build/scheduler        or   cc -O2 -pthread examples/scheduler.c -lm -o scheduler */
#define _POSIX_C_SOURCE 200809L
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"
#include <pthread.h>
#include <time.h>

/* Threads that wait for a job, take its indices one by one and say when none is left. Worker 0 is the caller. */
enum { WORKERS_MAX = 64, W = 512, H = 512, RUNS = 9 };

typedef struct pool {
    pthread_t threads[WORKERS_MAX];
    pthread_mutex_t lock;
    pthread_cond_t begin, end;
    dist_task_fn task_fn;
    void *arg;
    int workers, started, count, next, busy, stop;
    unsigned long job;
} pool;

/* Takes indices until there are none. Called with the lock held; it is free while a task runs. */
static void pool_work(pool *p, int worker)
{
    while (p->next < p->count) {
        int index = p->next++;
        pthread_mutex_unlock(&p->lock);
        p->task_fn(p->arg, index, worker);
        pthread_mutex_lock(&p->lock);
    }
}

static void *pool_thread(void *user)
{
    pool *p = (pool *)user;
    pthread_mutex_lock(&p->lock);
    int worker = ++p->started;
    for (unsigned long seen = 0;;) {
        while (p->job == seen && !p->stop) {
            pthread_cond_wait(&p->begin, &p->lock);
        }
        if (p->stop) { break; }
        seen = p->job;
        pool_work(p, worker);
        if (--p->busy == 0) { pthread_cond_signal(&p->end); }
    }
    pthread_mutex_unlock(&p->lock);
    return NULL;
}

static void pool_run(void *user, int count, dist_task_fn task_fn, void *arg)
{
    pool *p = (pool *)user;
    pthread_mutex_lock(&p->lock);
    p->task_fn = task_fn;
    p->arg = arg;
    p->count = count;
    p->next = 0;
    p->busy = p->workers - 1;
    p->job++;
    pthread_cond_broadcast(&p->begin);
    pool_work(p, 0);
    while (p->busy > 0) {
        pthread_cond_wait(&p->end, &p->lock);
    }
    pthread_mutex_unlock(&p->lock);
}

static void pool_start(pool *p, int workers)
{
    memset(p, 0, sizeof *p);
    p->workers = workers;
    pthread_mutex_init(&p->lock, NULL);
    pthread_cond_init(&p->begin, NULL);
    pthread_cond_init(&p->end, NULL);
    for (int i = 1; i < workers; i++) {
        if (pthread_create(&p->threads[i], NULL, pool_thread, p) != 0) {
            fail("thread %.0f cannot be started", (double)i);
        }
    }
}

static void pool_stop(pool *p)
{
    pthread_mutex_lock(&p->lock);
    p->stop = 1;
    pthread_cond_broadcast(&p->begin);
    pthread_mutex_unlock(&p->lock);
    for (int i = 1; i < p->workers; i++) {
        pthread_join(p->threads[i], NULL);
    }
    pthread_cond_destroy(&p->begin);
    pthread_cond_destroy(&p->end);
    pthread_mutex_destroy(&p->lock);
}

typedef struct job {
    dist_context *ctx;
    dist_net *net;
    dist_shape *shape;
    dist_field field;
    float *depth;
    double best;
} job;

static void job_begin(job *j, const dist_context_desc *desc)
{
    j->ctx = dist_context_create(desc);
    j->net = load_model(j->ctx, "embedded");
    j->shape = dist_shape_create(j->ctx, j->net, dist_net_code(j->net, 0));
    j->field = dist_shape_field(j->shape);
    j->depth = take_floats((size_t)W * H);
    j->best = 1e30;
    check(j->ctx);
}

static void job_render(job *j)
{
    view v = view_default(W, H);
    dist_camera camera = view_camera(&v, 0.0f);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = j->depth;
    nanosleep(&(struct timespec){0, 50000000}, NULL); /* OpenMP's threads wait busily for a while after their turn */
    double start = seconds_now();
    dist_render(j->ctx, &j->field, &camera, NULL, &out, NULL);
    double seconds = seconds_now() - start;
    j->best = seconds < j->best ? seconds : j->best;
    check(j->ctx);
}

static void job_end(job *j)
{
    free(j->depth);
    dist_shape_destroy(j->shape);
    dist_net_destroy(j->net);
    dist_context_destroy(j->ctx);
}

int main(int argc, char **argv)
{
    char *end = NULL;
    long workers_asked = argc > 1 ? strtol(argv[1], &end, 10) : 2;
    if (argc > 2 || (end && (end == argv[1] || *end)) || workers_asked < 1 || workers_asked > WORKERS_MAX) {
        fail("scheduler [N]: the number of workers, 1 to %d (default 2)", (int)WORKERS_MAX);
    }
    int workers = (int)workers_asked;
    pool threads;
    pool_start(&threads, workers);
    dist_context_desc with_pool = {.workers = workers, .scheduler = {&threads, pool_run}};
    dist_context_desc with_openmp = {.workers = workers};
    job ours;
    job theirs;
    job_begin(&ours, &with_pool);
    job_begin(&theirs, &with_openmp);
    for (int i = 0; i < RUNS; i++) { /* in turn, so that other programs disturb both alike */
        job_render(&ours);
        job_render(&theirs);
    }
    int same = memcmp(ours.depth, theirs.depth, (size_t)W * H * sizeof(float)) == 0;
    printf("%d x %d picture, %d workers: pool %.4f s, %s %.4f s; %s\n", W, H, workers, ours.best,
           dist_context_workers(theirs.ctx) > 1 ? "OpenMP" : "without OpenMP, one worker,", theirs.best,
           same ? "the same bits" : "different bits");
    job_end(&ours);
    job_end(&theirs);
    pool_stop(&threads);
    return same ? 0 : 1;
}
