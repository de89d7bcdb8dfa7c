// SPDX-License-Identifier: BSD-3-Clause
// Services and parameters: calling, and providing with roslib. See run.mjs.

import { collect, once } from './wait.mjs';

const ADD = 'rosbridge_library/AddTwoInts';

// The answers to some calls, made at once, in the order of the calls.
export async function call(page, { calls }) {
  const ros = await page.connect();
  return Promise.all(calls.map(([name, type, values, ...more]) => page.call(ros, name, type, values, ...more)));
}

// A call that the bridge gives up, while others go on; how long it took, in ms.
export async function giveUp(page, { timeout }) {
  const ros = await page.connect();
  const begin = performance.now();
  const order = [];
  const note = async (name, ...more) => {
    const answer = await page.call(ros, ...more);
    order.push(name);
    return answer;
  };
  const [hanging, sum] = await Promise.all([
    note('hanging', '/robot/hang', ADD, { a: 1, b: 2 }, ...(timeout === undefined ? [] : [timeout])),
    note('add', '/robot/add', ADD, { a: 1, b: 2 }),
  ]);
  return { hanging, sum, order, took: performance.now() - begin };
}

// Has the robot, a ROS node, call a service; its answer.
let asked = 0;
async function askRobot(page, ros, service, values) {
  asked += 1;
  const answerTo = `${service}/answer${asked}`;
  const ask = new page.roslib.Topic({ ros, name: '/robot/call', messageType: 'std_msgs/String' });
  ask.publish(page.message({ data: JSON.stringify({ service, ...values, answer_to: answerTo }) }));
  const [answer] = await collect(new page.roslib.Topic({ ros, name: answerTo, messageType: 'std_msgs/String' }), 1);
  ask.unadvertise();
  return JSON.parse(answer.data);
}

// A service in the program, called from ROS and from another client, then taken back.
export async function provide(page, { name }) {
  const [ros, other] = [await page.connect(), await page.connect()];
  const service = new page.roslib.Service({ ros, name, serviceType: ADD });
  const requests = [];
  await service.advertise((request, response) => {
    requests.push(request);
    response.sum = request.a + request.b;
    return request.a < 0 ? false : true;
  });
  const fromRobot = await askRobot(page, ros, name, { a: 20, b: 22 });
  const many = await Promise.all([1, 2, 3].map((a) => page.call(other, name, ADD, { a, b: 10 })));
  // 1.x sends the response's values with the false, and values count; 2.x sends none.
  const failing = await askRobot(page, ros, name, { a: -1, b: 0 });
  const typeName = await new Promise((resolve, reject) => other.getServiceType(name, resolve, reject));
  await service.unadvertise();
  await page.call(ros, '/robot/add', ADD, { a: 1, b: 1 });
  const gone = await page.call(other, name, ADD, { a: 1, b: 1 });
  return { fromRobot, many, failing, typeName, gone, requests };
}

// A service whose callback returns nothing, as many programs' do.
export async function provideCarelessly(page, { name }) {
  const ros = await page.connect();
  const service = new page.roslib.Service({ ros, name, serviceType: ADD });
  const returned = { 1: undefined, 2: null, 3: 1, 4: 'yes' };
  await service.advertise((request, response) => {
    response.sum = request.a;
    return returned[request.a];
  });
  return Promise.all(Object.keys(returned).map((a) => askRobot(page, ros, name, { a: Number(a), b: 0 })));
}

// 2.x has services that answer later, or fail with a reason.
export async function provideLater(page, { name }) {
  const ros = await page.connect();
  const service = new page.roslib.Service({ ros, name, serviceType: ADD });
  await service.advertiseAsync(async ({ a, b }) => {
    await new Promise((resolve) => setTimeout(resolve, 5 * a));
    if (a === 3) throw new Error('three is not to be added');
    return { sum: a + b };
  });
  return Promise.all([3, 2, 1].map((a) => askRobot(page, ros, name, { a, b: 10 })));
}

// A second program takes over a service and leaves it; then a third has it.
export async function provideAgain(page, { name }) {
  const [first, second, third, other] = await Promise.all([1, 2, 3, 4].map(() => page.connect()));
  const answers = [];
  for (const [number, ros] of [first, second, third].entries()) {
    const service = new page.roslib.Service({ ros, name, serviceType: ADD });
    await service.advertise((request, response) => {
      response.sum = number;
      return true;
    });
    await page.call(ros, '/robot/add', ADD, { a: 1, b: 1 }); // by now it is advertised
    answers.push(await page.call(other, name, ADD, { a: 0, b: 0 }));
    if (number === 1) await service.unadvertise();
  }
  return answers;
}

// A program that closes while it owes an answer: the caller is told at once.
export async function provideAndLeave(page, { name }) {
  const [ros, other] = [await page.connect(), await page.connect()];
  // What the handler gets is passed on as a promise that never resolves: the answer is owed.
  const called = once(ros, name);
  ros.callOnConnection({ op: 'advertise_service', service: name, type: ADD });
  await page.call(ros, '/robot/add', ADD, { a: 1, b: 1 });
  const answer = page.call(other, name, ADD, { a: 1, b: 1 });
  await called;
  const begin = performance.now();
  ros.close();
  return { answer: await answer, took: performance.now() - begin };
}

// Sets, gets and deletes parameters of all kinds.
export async function params(page, { name, values }) {
  const ros = await page.connect();
  const param = new page.roslib.Param({ ros, name });
  const get = () => new Promise((resolve, reject) => param.get(resolve, reject));
  const got = [await get()];
  for (const value of values) {
    await new Promise((resolve, reject) => param.set(value, resolve, reject));
    page.say({ set: value });
    got.push(await get());
  }
  const names = await new Promise((resolve, reject) => ros.getParams(resolve, reject));
  await new Promise((resolve, reject) => param.delete(resolve, reject));
  got.push(await get());
  const again = await new Promise((resolve) => param.delete(() => resolve('deleted'), (reason) => resolve({ reason })));
  return { got, names, again };
}
